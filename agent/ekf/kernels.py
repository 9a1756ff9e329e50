"""Which form of the costly products runs: compiled where numba is installed, else NumPy's.

The choice is made when the first filter is made, not when this is imported: who asks for help on the command
line does not wait for a compiler.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from agent.ekf import algebra
from hybridmap.recognising.kernels import kernels

PRODUCTS = (
    "drive", "advance",
    "slots_of", "sighted", "told", "innovations", "vote",
    "spread", "whiten", "leave_one_out", "examine", "glance", "wheel_errors", "condition",
)  # fmt: skip


def load() -> None:
    """Choose, and compile if that was never done here."""
    if "COMPILED" not in globals():
        form = _compiled()
        globals().update({name: getattr(form or algebra, name) for name in PRODUCTS})
        globals()["COMPILED"] = form is not None
        # A robot that maps will recognise places too, and must not wait for a compiler then.
        kernels()


def _compiled() -> ModuleType | None:
    try:
        import numba  # noqa: F401
        import scipy.linalg  # noqa: F401
    except ImportError:
        return None
    from agent.ekf import compiled

    return compiled


def __getattr__(name: str) -> Any:
    """One of the products, or COMPILED: whether this installation has what the compiled form needs."""
    if name in PRODUCTS or name == "COMPILED":
        load()
        return globals()[name]
    raise AttributeError(name)
