"""The files of a folder of images: images/, times.txt, odometry.csv."""

import csv
import math
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.agent.recordings.pose_files import CSV_COLUMNS
from mapweave.agent.recordings.table_file import read_text, rows_of
from mapweave.agent.recordings.toml_file import number
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.limits import MAX_STAMP_NS

INCREMENT_COLUMNS = ("forward_m", "turn_rad")
OR_POSES = f", or as poses {', '.join(CSV_COLUMNS)}"
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".pgm", ".bmp"}


def images_of(folder: Path) -> list[Path]:
    """The images of a recording in the order of the numbers in their names: in images/, else in it itself.

    Raises:
        DeviceError: there are none, or one is there in two formats.
    """
    inside = folder / "images"
    images = images_in(folder if has_images(folder) and not inside.exists() else inside)
    for before, image in pairwise(sorted(images, key=lambda path: path.stem)):
        if before.stem == image.stem:
            both = " and ".join(sorted((before.name, image.name)))
            raise DeviceError(f"{image.parent}: {both} are one image; keep one format")
    return images


def images_in(folder: Path) -> list[Path]:
    """The images in a folder in the order of the numbers in their names.

    Raises:
        DeviceError: there are none.
    """
    images = list(_images(folder))
    if not images:
        raise DeviceError(f"{folder}: no images there (png, jpg, pgm or bmp)")
    return sorted(images, key=_natural_order)


def has_images(folder: Path) -> bool:
    """Whether images lie in a folder itself."""
    return next(_images(folder), None) is not None


def _images(folder: Path) -> Iterator[Path]:
    # On disks of others macOS keeps a file `._0001.png` of its own beside each.
    return (path for path in folder.glob("[!.]*") if path.suffix.lower() in IMAGE_SUFFIXES)


def _natural_order(path: Path) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"\d+", path.stem)], path.name


def read_times(path: Path, count: int) -> tuple[np.ndarray[Any, np.dtype[np.float64]], str]:
    """Times of the images, of a times.txt; ten images a second without one.

    Returns:
        (K,) s, ascending, of the first K images, and what is missing, in one line; empty if K is `count`.

    Raises:
        DeviceError: it is wrong, or has no time at all, or more times than there are images: then it is not
            known which image is missing.
    """
    if not path.exists():
        return np.linspace(0.0, 0.1 * (count - 1), count), ""
    text, damage = read_text(path)
    if damage:
        raise DeviceError(damage)
    words = text.split()
    given = len(words)
    # The number that a file without a last line's end ends in may have had more digits.
    words = words[:-1] if given < count and not text.endswith("\n") else words
    times = np.empty(len(words))
    for row, word in enumerate(words):
        try:
            times[row] = float(word)
        except ValueError:
            raise DeviceError(
                f"{path}: line {row + 1}: {word[:20]!r} is no time; there must be seconds alone, a line for "
                "each image"
            ) from None
    if given > count or not len(times):
        raise DeviceError(
            f"{path}: {given} times for {count} images; there must be a line for each image: remove the "
            "lines of images that are missing, or remove the file (then ten images a second are assumed)"
        )
    lacking = f"{path}: {given} times for {count} images" if given < count else ""
    wrong = np.flatnonzero(~(np.isfinite(times) & (np.diff(times, prepend=-np.inf) > 0)))
    if len(wrong):
        line = int(wrong[0])
        raise DeviceError(f"{path}: line {line + 1}: {float(times[line])}: times must be finite and ascend")
    if not 0.0 <= times[0] <= times[-1] <= MAX_STAMP_NS / 1e9:
        raise DeviceError(f"{path}: times are seconds since 1970 or since the start, not {times[0]:g}")
    return times, lacking


def read_increments(path: Path, count: int) -> tuple[np.ndarray[Any, np.dtype[np.float64]], str]:
    """Forward, m, and turn, rad, since the image before, of an odometry.csv.

    Returns:
        (K, 2) the rows before the first that is damaged, and what is damaged, in one line; empty if nothing
        is, and K is `count`.

    Raises:
        DeviceError: it is missing or wrong, or has less than two rows that can be read.
    """
    text, damage = read_text(path)
    rows: list[tuple[float, float]] = []
    if text:
        reader = rows_of(path, text.splitlines(), INCREMENT_COLUMNS, OR_POSES)
        try:
            for row in reader:
                values = number(row, "forward_m"), number(row, "turn_rad")
                if not all(map(math.isfinite, values)):
                    raise ValueError("there must be one finite row for each image")
                rows.append(values)
        except (ValueError, TypeError, csv.Error) as error:
            damage = f"{path}: line {reader.line_num}: {error}"
    if (len(rows) >= count and damage) or len(rows) > count:
        raise DeviceError(damage or f"{path}: {len(rows)} rows for {count} images; there must be one each")
    if len(rows) < count and not damage:
        damage = f"{path}: {len(rows)} rows for {count} images"
        # The number that a file without a last line's end ends in may have had more digits.
        rows = rows if text.endswith("\n") else rows[:-1]
    if len(rows) < 2:
        raise DeviceError(damage or f"{path}: {count} images are no drive; there must be two or more")
    return np.array(rows), damage
