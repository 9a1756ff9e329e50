"""Libraries that take long to import: loaded once the map is shown, before a robot has to wait for them."""

from __future__ import annotations

from importlib import import_module

from mapweave.hybridmap import jit

SLOW = (
    "faiss", "gtsam", "scipy.linalg", "scipy.sparse.csgraph", "scipy.sparse.linalg", "scipy.spatial",
    "scipy.special",
)  # fmt: skip
"""Imported by the functions that use them. A second together, in which a server can show its map already."""


def load_libraries() -> None:
    """Import the libraries and compile the kernels: no robot that asks waits for an import or a compiler."""
    for name in SLOW:
        import_module(name)
    jit.load()
