"""One process each: a robot's agent, the simulator; ended with their parent."""
