"""The robots into which a recording is cut."""

from __future__ import annotations

import tomllib
from pathlib import Path

from hybridmap.errors import DeviceError


def robots_of(path: Path) -> list[str]:
    """Names of the robots in a splits.toml, as they stand there.

    Raises:
        DeviceError: it cannot be read.
    """
    try:
        return [str(robot["name"]) for robot in tomllib.loads(path.read_text(encoding="utf-8"))["robot"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DeviceError(f"{path}: {type(error).__name__}: {error}") from None
