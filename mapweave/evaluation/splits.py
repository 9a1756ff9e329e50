"""The robots into which a recording is cut."""

from __future__ import annotations

import tomllib
from pathlib import Path

from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.atomic_file import read_whole


def robots_of(path: Path) -> list[str]:
    """Names of the robots in a splits.toml, in their order.

    Raises:
        DeviceError: it cannot be read.
    """
    try:
        robots = tomllib.loads(read_whole(path).decode("utf-8")).get("robot", [])
        return [str(robot["name"]) for robot in robots]
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: {error}") from None
    except (KeyError, TypeError):
        raise DeviceError(f"{path}: write a [[robot]] table with a name for each robot") from None
