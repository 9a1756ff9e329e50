"""Geometry of a drive: the camera's mount, the scales of wheels and clock, from tracks and odometry."""
