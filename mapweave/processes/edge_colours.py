"""Colours of edges by their kinds, for viewers."""

from __future__ import annotations

from mapweave.hybridmap.node import EdgeKind

COLOURS = {
    EdgeKind.MAPPED: (0.2, 0.7, 0.3), EdgeKind.TURNED: (0.6, 0.6, 0.6), EdgeKind.DRIVEN: (0.2, 0.5, 0.9),
    EdgeKind.LOOP: (0.95, 0.6, 0.1), EdgeKind.MERGED: (0.85, 0.2, 0.6),
}  # fmt: skip
"""Red, green and blue, 0 to 1."""
