"""Kernels: NumPy code that numba compiles where it is installed, and that runs uncompiled elsewhere.

    @for_each
    def square(n: Index, rows: Matrix, out: Vector) -> None:
        out[n] = rows[n, 0] ** 2 + rows[n, 1] ** 2

    @compiled
    def lengths(rows: Matrix) -> Vector:
        out = np.empty(len(rows))
        square(len(rows), rows, out)
        return np.sqrt(out)

What is computed for each of many is written once, for number n, and called with their count. numba loops over
n; without it n is a slice, all of them, and each operation is one on arrays. So such a function has masks in
place of branches.

A kernel is compiled by `load` or when it is first called, for the types that its annotations name, and kept
on disk next to its module. numba checks only that file for changes: a kernel
uses only constants, and calls only kernels, of its own module.

numba takes half a second to import. A kernel of whole numbers gives the same in both forms, so its first
calls run uncompiled: who reads a small map does not wait for numba.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cached_property, update_wrapper
from inspect import signature
from types import FunctionType
from typing import Annotated, Any, Concatenate, Generic, ParamSpec, TypeVar, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

log = logging.getLogger(__name__)

P = ParamSpec("P")
R = TypeVar("R")

Vector = Annotated[NDArray[np.float64], 1]
Matrix = Annotated[NDArray[np.float64], 2]
Cube = Annotated[NDArray[np.float64], 3]
Flags = Annotated[NDArray[np.bool_], 1]
"""Arrays of so many dimensions, dense and in C's order."""

Index = Any
"""The number of one of many, or all of them."""

ALL = slice(None)

_OPTIONS = {"error_model": "numpy", "fastmath": {"contract"}}
"""A product and its sum may be one instruction; sums keep their order."""

KERNELS: list[Kernel[..., Any]] = []
"""All kernels of the modules that are imported."""

UNCOMPILED = 300
"""Calls of a kernel of whole numbers before it is compiled. To read the landmarks of a node is one, which
costs 1.1 ms uncompiled and 0.1 ms compiled; so these calls cost as much as importing numba does."""


class Kernel(Generic[P, R]):
    """A function that may be compiled.

    Attributes:
        python: the function without numba.
    """

    def __init__(self, function: Callable[..., Any], python: Callable[P, R], loop: str | None = None) -> None:
        """Take a function; nothing is compiled yet.

        Args:
            function: as it is written.
            python: what a call does without numba.
            loop: source of what a call does with numba: calls of `one`, with ... for the arguments behind the
                indices. None for the function itself.
        """
        self.python = python
        self._function: Any = function
        self._loop = loop
        self._uncompiled = 0 if loop or not _is_whole(function) else UNCOMPILED
        update_wrapper(self, function)
        KERNELS.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the compiled form where there is numba."""
        if self._uncompiled and "machine" not in self.__dict__:
            self._uncompiled -= 1
            return self.python(*args, **kwargs)
        return self.machine(*args, **kwargs)

    @cached_property
    def machine(self) -> Callable[P, R]:
        """What a call runs."""
        try:
            import numba
            import scipy.linalg  # noqa: F401, numba takes LAPACK from it
        except ImportError:
            return self.python
        if numba.config.DISABLE_JIT:
            return self.python
        form: Callable[P, R] = self._looping(numba) if self._loop else self._kept(numba)
        return form

    @property
    def compiled_now(self) -> bool:
        """Whether it was compiled in this process; makes `machine` ready."""
        statistics = None if self._loop else getattr(self.machine, "stats", None)
        return statistics is not None and not statistics.cache_hits

    def _kept(self, numba: Any) -> Any:
        """Compiled for the annotated types."""
        try:
            machine = numba.njit(cache=True, **_OPTIONS)(self._linked())
        except RuntimeError:
            # Nowhere to keep it: an installation that may not be written to, and no home either.
            machine = numba.njit(**_OPTIONS)(self._linked())
        hints = get_type_hints(self._function, include_extras=True)
        types = tuple(_type_of(hint) for name, hint in hints.items() if name != "return")
        try:
            machine.compile(types)
        except Exception:  # noqa: BLE001 - what is unpickled of another version, or of a damaged file, raises anything
            machine = self._compiled_again(numba, machine)
            machine.compile(types)
        return machine

    def _compiled_again(self, numba: Any, machine: Any) -> Any:
        """The same without what is kept on disk.

        numba reads all of it before it looks whether it is of this source: that of an earlier version of this
        program may name a class that has another name now, and a file may be cut off.
        """
        try:
            machine._cache.flush()
        except OSError:
            return numba.njit(**_OPTIONS)(self._linked())
        return numba.njit(cache=True, **_OPTIONS)(self._linked())

    def _looping(self, numba: Any) -> Any:
        """Mark a function to be compiled into the kernels that call it, for their types."""
        # If the call names each argument, numba makes one loop of both: three times as fast.
        count = len(signature(self._function).parameters) - str(self._loop).count("range")
        arguments = ", ".join(f"argument{k}" for k in range(count))
        scope = {"one": numba.njit(inline="always", **_OPTIONS)(self._linked()), "empty": np.empty}
        exec(str(self._loop).replace("...", arguments), scope)
        return numba.njit(**_OPTIONS)(scope["loop"])

    def _linked(self) -> FunctionType:
        """The function, with the compiled forms of the kernels that it calls."""
        source = self._function
        called = {name: source.__globals__.get(name) for name in source.__code__.co_names}
        machines = {name: kernel.machine for name, kernel in called.items() if isinstance(kernel, Kernel)}
        linked = FunctionType(source.__code__, {**source.__globals__, **machines}, source.__name__)
        linked.__qualname__ = source.__qualname__
        return linked


def compiled(function: Callable[P, R]) -> Kernel[P, R]:
    """Compile a function whose annotations name its types: `Matrix` and the like, numbers, named tuples."""
    return Kernel(function, function)


def compiled_form_of(python: Callable[P, R]) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Have numba compile a function with loops, and run another that does the same in NumPy without it."""
    return lambda function: Kernel(function, python)


def for_each(function: Callable[Concatenate[Index, P], None]) -> Kernel[Concatenate[int, P], None]:
    """Call function(n, ...) for each n below a count, which is given in place of n."""

    def python(count: int, *args: P.args, **kwargs: P.kwargs) -> None:
        function(ALL, *args, **kwargs)

    loop = """def loop(count, ...):
    for n in range(count):
        one(n, ...)"""
    return Kernel(function, python, loop)


def for_each_pair(
    function: Callable[Concatenate[Index, Index, P], Any],
) -> Kernel[Concatenate[int, int, P], Matrix]:
    """(M, N) table of function(m, n, ...); M and N are given in place of m and n. Only vectors take m."""

    def python(rows: int, columns: int, *args: P.args, **kwargs: P.kwargs) -> Matrix:
        table: Matrix = function((ALL, None), ALL, *args, **kwargs)
        return table

    loop = """def loop(rows, columns, ...):
    table = empty((rows, columns))
    for m in range(rows):
        for n in range(columns):
            table[m, n] = one(m, n, ...)
    return table"""
    return Kernel(function, python, loop)


def load() -> None:
    """Compile, or read from disk, all kernels imported so far: a robot that drives must not wait for it."""
    said = False
    for kernel in KERNELS:
        known = "machine" in kernel.__dict__  # compiled by an earlier call
        if kernel.compiled_now and not (known or said):
            said = True
            log.warning("compiling what runs often, once for this computer: this takes up to a minute")


def _is_whole(of: Any) -> bool:
    """Whether a function, or a named tuple, has whole numbers alone, by its annotations."""
    return all(
        hint in (int, type(None))
        or (hasattr(hint, "_fields") and _is_whole(hint))
        or (hasattr(hint, "__metadata__") and np.issubdtype(_scalar(hint), np.integer))
        for hint in get_type_hints(of, include_extras=True).values()
    )


def _scalar(hint: Any) -> Any:
    """Type of the elements of an annotated array.

    From NumPy 2.5 on `NDArray` is an alias, which has the type itself and not the `dtype` of it.
    """
    last = get_args(get_args(hint)[0])[-1]
    return next(iter(get_args(last)), last)


def _type_of(hint: Any) -> Any:
    """What numba calls an annotated type."""
    import numba

    if (dimensions := getattr(hint, "__metadata__", None)) is not None:
        return numba.types.Array(numba.from_dtype(np.dtype(_scalar(hint))), dimensions[0], "C")
    if hasattr(hint, "_fields"):
        fields = [_type_of(of) for of in get_type_hints(hint, include_extras=True).values()]
        return numba.types.BaseTuple.from_types(fields, hint)
    return numba.typeof(hint())
