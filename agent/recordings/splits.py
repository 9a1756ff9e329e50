"""splits.toml: the robots into which a recording is cut."""

from pathlib import Path
from typing import Any

from mapweave.agent.recordings.toml_file import read_table, whole
from mapweave.hybridmap.errors import DeviceError


def robots_of(path: Path) -> list[str]:
    """Names of the robots in a splits.toml, in their order.

    Raises:
        DeviceError: it cannot be read.
    """
    return [name for name, _ in _tables(path, "it must describe the robots")]


def read_split(path: Path, robot: str | None, count: int) -> range:
    """The images of one robot of a splits.toml; all without a robot.

    Raises:
        DeviceError: the file is missing or wrong, or has no such robot.
    """
    if robot is None:
        return range(count)
    robots = dict(_tables(path, f"it must describe robot {robot!r}"))
    if robot not in robots:
        raise DeviceError(f"{path}: no robot {robot!r}; there are {', '.join(sorted(robots)) or 'none'}")
    split = {"step": 1, **robots[robot]}
    try:
        first, last, step = (whole(split, name) for name in ("first", "last", "step"))
    except (KeyError, ValueError) as error:
        raise DeviceError(f"{path}: robot {robot!r}: {error}") from None
    if step < 1:
        raise DeviceError(f"{path}: robot {robot!r}: step {step} must be 1 or more")
    if not 0 <= first <= last < count:
        raise DeviceError(
            f"{path}: robot {robot!r}: frames {first} to {last} are not within the {count} images"
        )
    return range(first, last + 1, step)


def _tables(path: Path, advice: str) -> list[tuple[str, dict[str, Any]]]:
    """Name and table of each robot."""
    try:
        return [(str(robot["name"]), robot) for robot in read_table(path, advice).get("robot", [])]
    except (KeyError, TypeError):
        raise DeviceError(f"{path}: write a [[robot]] table with a name for each robot") from None
