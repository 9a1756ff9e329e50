"""Errors that a driver's own code raises, as one line with the file and line of that code."""

from __future__ import annotations

import traceback

from mapweave.hybridmap.errors import DeviceError


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

    Args:
        error: was caught.

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
