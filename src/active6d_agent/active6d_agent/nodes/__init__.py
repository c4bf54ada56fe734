"""ROS nodes of the agent."""
