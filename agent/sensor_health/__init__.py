"""Whether a robot's own sensors can be believed: camera, encoders, clock, rangers."""
