"""How the compiled form of the products is compiled: once, by numba, and then kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

MATRIX, VECTOR, CUBE, SLOTS = "float64[:, ::1]", "float64[::1]", "float64[:, :, ::1]", "intp[::1]"
"""Types of arguments and results: dense arrays in C's order."""


def machine_code(result: str, *arguments: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile for these types now, at import: a robot that drives must not wait for a compiler."""
    signature = f"{result}({', '.join(arguments)})"

    def made(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return _compile(signature, function, cache=True)
        except RuntimeError:
            # Nowhere to keep it: an installation that may not be written to, and no home either.
            return _compile(signature, function, cache=False)

    return made


def _compile(signature: str, function: Callable[..., Any], cache: bool) -> Callable[..., Any]:
    # A product and its sum may be one instruction; sums keep their order.
    options = {"cache": cache, "error_model": "numpy", "fastmath": {"contract"}}
    made: Callable[..., Any] = njit(signature, **options)(function)
    return made
