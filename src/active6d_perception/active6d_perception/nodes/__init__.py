"""ROS 2 nodes; every calculation is in the modules beside this package."""
