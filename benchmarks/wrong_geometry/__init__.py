"""Robots with wrong geometry: what they do to the answers of others."""
