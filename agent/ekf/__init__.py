"""Estimation: the mapping filter (3 + 3n), the localization filter (3 + 2n), and their gates."""
