"""What lies between a camera driver and the graph, without ROS: rectification, registration, the choice of frames."""
