"""Worlds to drive in: made from a seed and a few parameters, or read from a file."""
