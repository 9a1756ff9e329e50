"""ROS 2 topics over Zenoh without ROS: the keys and messages of rmw_zenoh and of zenoh-bridge-ros2dds."""
