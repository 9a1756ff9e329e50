"""Which form of the inner loops runs: compiled where numba is installed, else NumPy's.

The choice is made at the first use, not when this is imported: who asks for help on the command line does not
wait for a compiler.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType

from hybridmap.recognising import algebra


@cache
def kernels() -> ModuleType:
    """compiled.py, or algebra.py where this installation lacks what that needs."""
    try:
        import numba  # noqa: F401
        import scipy.linalg  # noqa: F401
    except ImportError:
        return algebra
    from hybridmap.recognising import compiled

    return compiled
