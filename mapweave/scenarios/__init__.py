"""Trials: a scenario in the simulator, from the first tick to the verdict."""
