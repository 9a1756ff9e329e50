"""Libraries that take long to import: loaded once the map is shown, before a robot has to wait for them."""

from collections.abc import Callable
from functools import partial
from importlib import import_module

from mapweave.hybridmap import jit

SLOW = (
    "faiss", "gtsam", "scipy.linalg", "scipy.sparse.csgraph", "scipy.sparse.linalg", "scipy.spatial",
    "scipy.special",
)  # fmt: skip
"""Imported by the functions that use them. A second together, in which a server can show its map already."""


def library_jobs() -> list[Callable[[], None]]:
    """Jobs that import the libraries and compile the kernels: no robot that asks waits for these.

    Each is a job by itself, so that a server which is stopped meanwhile ends without the rest.
    """
    return [*(partial(_load, name) for name in SLOW), jit.load]


def _load(name: str) -> None:
    import_module(name)
