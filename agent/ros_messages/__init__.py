"""ROS messages to the agent's values and back, for bags and for robots. Others decode their bytes."""
