"""Mistakes of a driver's author as errors of one line: what its code raises, and what its base gives."""

import math
import traceback
from numbers import Real

import numpy as np

from mapweave.agent.drivers.base import Base, BaseReading, Wheels
from mapweave.hybridmap.errors import DeviceError

METHODS = ("open", "close", "nearest", "drive", "read")
EARLIEST_NS = 10**18
"""In 2001. Stamps since 1970 in seconds, milliseconds and microseconds are smaller numbers."""


def check_base(base: Base) -> None:
    """Refuse what is no base.

    Raises:
        DriverMistake: it is a class, or lacks methods.
    """
    if isinstance(base, type):
        raise mistake("base", f"is the class {base.__name__}; it must be an object, {base.__name__}(...)")
    lacking = [name for name in METHODS if not callable(getattr(base, name, None))]
    if lacking:
        raise mistake("base", f"{kind_of(base)} needs {', '.join(METHODS)}; it lacks {', '.join(lacking)}")


def check_reading(reading: object) -> None:
    """Refuse a reading that would fail, or count for nothing, later on.

    Raises:
        DriverMistake: says what is wrong with it.
    """
    if not isinstance(reading, BaseReading):
        raise mistake("read()", f"must return a BaseReading, not {kind_of(reading)}")
    check_wheels("read(): way", reading.way)
    for name in ("bumped", "kidnapped"):
        value = getattr(reading, name)
        if not isinstance(value, bool | np.bool_):
            raise mistake(f"read(): {name}", f"must be True or False, not {value!r}")
    stamp_ns = reading.stamp_ns
    if stamp_ns is None:
        return
    if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer) or stamp_ns < EARLIEST_NS:
        raise mistake("read(): stamp_ns", f"is {stamp_ns!r}; it must be nanoseconds since 1970, an int")


def check_wheels(what: str, wheels: object) -> None:
    """Refuse what are not two finite numbers.

    Raises:
        DriverMistake: says what is wrong with it.
    """
    if not isinstance(wheels, Wheels):
        raise mistake(what, f"must be Wheels, not {kind_of(wheels)}")
    if not all(isinstance(value, Real) and math.isfinite(value) for value in wheels):
        raise mistake(what, f"must be two finite numbers, not {wheels.left!r} and {wheels.right!r}")


class DriverMistake(DeviceError):
    """A driver does not give what its protocol says: to connect again does not help."""


def mistake(what: str, words: str) -> DriverMistake:
    """A mistake for the driver's author, as one line: what it is in, and what is wrong with it."""
    return DriverMistake(f"driver: {what} {words}")


def kind_of(value: object) -> str:
    """The type of a value, in words."""
    return "None" if value is None else type(value).__name__


def driver_error(error: BaseException) -> DeviceError:
    """An error of the code of a driver, for its author.

    Returns:
        One line that names the file, the line and the error.

    Raises:
        BaseException: `error` itself, if no code outside of this package was running: the mistake is here.
    """
    frames = [
        (frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if not frame.f_globals.get("__name__", "").startswith("mapweave.")
    ]
    if not frames:
        raise error
    # The driver calls libraries; their lines do not help its author.
    path = frames[0][0]
    line = [line for file, line in frames if file == path][-1]
    return DeviceError(f"driver: {path}, line {line}: {type(error).__name__}: {' '.join(str(error).split())}")
