"""Cutting a recording into robots: by its splits.toml, or into overlapping pieces."""

import re
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console

from mapweave.agent.drivers.replay import Replay
from mapweave.agent.recordings.image_folder import images_of
from mapweave.agent.recordings.splits import robots_of
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.hybridmap.ids import check_name

OVERLAP = 0.3
"""Of a piece, what the next one shares with it."""
LEAST_IMAGES = 20
"""A piece with fewer maps nothing."""
MOST_ROBOTS = 26
"""Pieces are named by letters."""


def say(lines: Iterable[str], console: Console) -> None:
    """Print what is wrong with a recording, a line each; what several robots have in common once."""
    for line in dict.fromkeys(lines):
        console.print(line, highlight=False, markup=False)


def pieces(folder: Path, robots: int | None) -> dict[str, Replay]:
    """The robots of a recording, by names as the fleet knows them.

    Args:
        folder: the recording.
        robots: cut it into so many consecutive pieces; None cuts it by its splits.toml. Neighbouring
            pieces share 30 % of their way, where one takes the even images and the next the odd ones, so
            that no image is in two of them.

    Raises:
        DeviceError: the recording lacks something, or cannot be cut like this.
    """
    check_folder(folder, "images/, camera.toml and odometry.csv")
    if not (folder / "images").is_dir():
        raise DeviceError(f"{folder}: has no images/; only folders of images can be cut and scored")
    if robots is None:
        file = folder / "splits.toml"
        if not file.exists():
            raise DeviceError(f"{folder}: no splits.toml to cut it by; give --robots 2 or 3")
        given = robots_of(file)
        if len(given) < 2:
            raise DeviceError(f"{file}: merging needs two robots or more; there is only {len(given)}")
        names = _names(given, file)
        return {name: Replay(folder, robot) for name, robot in zip(names, given, strict=True)}
    if not 2 <= robots <= MOST_ROBOTS:
        raise DeviceError(f"--robots {robots}: use 2 to {MOST_ROBOTS}")
    count = len(images_of(folder))
    cuts = cut(count, robots)
    if min(map(len, cuts)) < LEAST_IMAGES:
        raise DeviceError(
            f"{folder}: {count} images are too few for {robots} robots; each needs {LEAST_IMAGES} at least"
        )
    return {f"r{k}": Replay(folder, frames=frames) for k, frames in enumerate(cuts)}


def check_folder(folder: Path, needs: str) -> None:
    """Refuse what is no folder.

    Args:
        folder: of a recording that is to be scored.
        needs: what must be in it, in words.

    Raises:
        DeviceError: it is missing, or a file: bags and videos have neither splits.toml nor truth.csv.
    """
    if folder.is_file():
        raise DeviceError(f"{folder}: bags and videos cannot be scored; give a folder with {needs}")
    if not folder.is_dir():
        raise DeviceError(f"{folder}: no such folder; give one with {needs}")


def cut(count: int, robots: int) -> list[range]:
    """Consecutive ranges of images that overlap; of neighbours, one takes the even images, one the odd."""
    length = count / (robots - (robots - 1) * OVERLAP)
    ranges = []
    for k in range(robots):
        first = round(k * (1.0 - OVERLAP) * length)
        first += (first + k) % 2
        last = count if k == robots - 1 else min(count, round(k * (1.0 - OVERLAP) * length + length))
        ranges.append(range(first, last, 2))
    return ranges


def _names(given: Iterable[str], file: Path) -> list[str]:
    """Names that agents may have.

    Raises:
        DeviceError: two robots would have the same.
    """
    names = [re.sub("[^a-z0-9_-]", "-", robot.lower()) for robot in given]
    try:
        names = [check_name(name) for name in names]
    except InvalidValue as error:
        raise DeviceError(f"{file}: {error}") from None
    if len(set(names)) < len(names):
        raise DeviceError(f"{file}: two robots have the same name: {', '.join(given)}")
    return names
