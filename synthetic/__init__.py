"""Worlds, runs and fleets without a simulator, with their truth; for tests and benchmarks."""
