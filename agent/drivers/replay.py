"""A robot that is a recording: the same pipeline runs on camera images and odometry from a folder.

Layout of a recording (README, "Recordings"): `images/`, `camera.toml`, `times.txt`, `odometry.csv`, and
optionally `splits.toml`, which cuts it into robots. `truth.csv` is for scoring and is never read here.
"""

from __future__ import annotations

import csv
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.image_file import read_grey
from mapweave.wire.packing import MAX_STAMP_NS

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".pgm", ".bmp"}
AXLE_PER_HEIGHT = 0.9
"""A recording does not give its robot's width; taller robots are wider."""


def read_camera(path: Path) -> tuple[Camera, tuple[float, float, float, float, float]]:
    """Read a `camera.toml`: px, and metres above the floor.

    Returns:
        The camera and the five coefficients of its lens.

    Raises:
        DeviceError: the file is missing or wrong.
    """
    try:
        values = tomllib.loads(read_whole(path).decode("utf-8"))
        camera = Camera(
            width=_whole(values["width"]), height=_whole(values["height"]), fx=_number(values, "fx"),
            fy=_number(values, "fy"), cx=_number(values, "cx"), cy=_number(values, "cy"),
            mount_height=_number(values, "height_m"),
            mount_forward=_number(values, "forward_m") if "forward_m" in values else 0.0,
        )  # fmt: skip
        k1, k2, p1, p2, k3 = (float(k) for k in values.get("distortion", (0.0,) * 5))
        if not all(math.isfinite(k) for k in (k1, k2, p1, p2, k3)):
            raise DeviceError(f"{path}: the lens's coefficients must be finite")
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file; it must give the camera's intrinsics") from None
    except KeyError as missing:
        raise DeviceError(f"{path}: {missing.args[0]!r} is missing") from None
    except (OSError, ValueError, TypeError, OverflowError, InvalidValue) as error:
        raise DeviceError(f"{path}: {error}") from None
    return camera, (k1, k2, p1, p2, k3)


def images_of(folder: Path) -> list[Path]:
    """The images of a recording in the order of the numbers in their names.

    Raises:
        DeviceError: there are none.
    """
    return images_in(folder / "images")


def images_in(folder: Path) -> list[Path]:
    """The images in a folder in the order of the numbers in their names.

    Raises:
        DeviceError: there are none.
    """
    images = [p for p in folder.glob("*") if p.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise DeviceError(f"{folder}: no images there (png, jpg, pgm or bmp)")
    return sorted(images, key=_natural_order)


class Replay:
    """The Robot protocol over a recording. It takes no commands."""

    def __init__(self, folder: Path, robot: str | None = None, frames: range | None = None) -> None:
        """Open a recording.

        Args:
            folder: the recording.
            robot: which robot of its `splits.toml`; None plays all frames.
            frames: only these, without regard to `splits.toml`; ascending.

        Raises:
            DeviceError: something is missing or wrong, in one line.
        """
        if not folder.is_dir():
            raise DeviceError(
                f"{folder}: no such folder; a recording is a folder with images/ and camera.toml"
            )
        self._camera, self._distortion = read_camera(folder / "camera.toml")
        self._images = images_of(folder)
        self._times = _read_times(folder / "times.txt", len(self._images))
        self._odometry = _read_odometry(folder / "odometry.csv", len(self._images))
        self._frames = frames or _read_split(folder / "splits.toml", robot, len(self._images))
        if not 0 <= self._frames[0] <= self._frames[-1] < len(self._images):
            raise DeviceError(f"{folder}: {self._frames} is not within the {len(self._images)} images")
        self._position = 0

    def __len__(self) -> int:
        """How many observations there are."""
        return len(self._frames)

    def describe(self) -> RobotDescription:
        """The camera; no rangers and no wheels to command."""
        tick = float(np.median(np.diff(self._times))) * self._frames.step if len(self._times) > 1 else 0.1
        return RobotDescription(
            camera=self._camera,
            distortion=self._distortion,
            axle=AXLE_PER_HEIGHT * max(self._camera.mount_height, 0.1),
            max_forward=0.0,
            max_turn=0.0,
            tick=tick,
        )

    def sense(self) -> Observation | None:
        """The next frame with the odometry since the one before; None at the end.

        Raises:
            DeviceError: an image cannot be read.
        """
        if self._position >= len(self._frames):
            return None
        frame = self._frames[self._position]
        before = self._frames[self._position - 1] if self._position else frame
        self._position += 1
        image = read_grey(self._images[frame], self._camera, "camera.toml")
        forward, turn = self._odometry[before + 1 : frame + 1].sum(axis=0)
        stamp_ns = round(self._times[frame] * 1e9)
        return Observation(stamp_ns, Odometry(float(forward), float(turn)), image)

    def act(self, command: Command) -> Command:
        """Nothing moves: what is applied is always standing still."""
        return Command()

    def close(self) -> None:
        """Nothing to let go of."""


def _number(values: Mapping[str, Any], name: str) -> float:
    value = values[name]
    try:
        return float(value)
    except (TypeError, ValueError):
        # A row of a table that is too short holds None.
        raise ValueError(f"{name} {'is missing' if value is None else f'{value!r} is no number'}") from None


def _whole(value: Any) -> int:
    if not isinstance(value, int):
        # What fits nowhere is refused rather than rounded: half a frame or pixel is a mistake.
        raise ValueError(f"{value!r} is no whole number")  # noqa: TRY004
    return value


def _natural_order(path: Path) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"\d+", path.stem)], path.name


def _read_times(path: Path, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    if not path.exists():
        return np.linspace(0.0, 0.1 * (count - 1), count)
    try:
        times = np.array([float(line) for line in read_whole(path).decode().split()])
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: {error}") from None
    if len(times) != count or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise DeviceError(f"{path}: {len(times)} times for {count} images; they must be one each and ascend")
    if not 0.0 <= times[0] <= times[-1] <= MAX_STAMP_NS / 1e9:
        raise DeviceError(f"{path}: times are seconds since 1970 or since the start, not {times[0]:g}")
    return times


def _read_odometry(path: Path, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(count, 2) forward m and turn rad since the image before."""
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            try:
                rows = [(_number(row, "forward_m"), _number(row, "turn_rad")) for row in reader]
            except ValueError as error:
                raise DeviceError(f"{path}: line {reader.line_num}: {error}") from None
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file; without odometry the map has no scale") from None
    except KeyError as missing:
        raise DeviceError(f"{path}: no column {missing.args[0]!r}") from None
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise DeviceError(f"{path}: {error}") from None
    if len(rows) != count or not all(math.isfinite(v) for row in rows for v in row):
        raise DeviceError(f"{path}: {len(rows)} rows for {count} images; there must be one finite row each")
    return np.array(rows)


def _read_split(path: Path, robot: str | None, count: int) -> range:
    if robot is None:
        return range(count)
    try:
        robots = {str(r["name"]): r for r in tomllib.loads(read_whole(path).decode("utf-8")).get("robot", [])}
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file; it must describe robot {robot!r}") from None
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: {error}") from None
    except (KeyError, TypeError):
        raise DeviceError(f"{path}: write a [[robot]] table with a name for each robot") from None
    if robot not in robots:
        raise DeviceError(f"{path}: no robot {robot!r}; there are {', '.join(sorted(robots)) or 'none'}")
    split = robots[robot]
    try:
        first, last, step = (_whole(v) for v in (split["first"], split["last"], split.get("step", 1)))
    except (KeyError, ValueError, TypeError) as error:
        raise DeviceError(f"{path}: robot {robot!r}: {error}") from None
    if step < 1:
        raise DeviceError(f"{path}: robot {robot!r}: step {step} must be 1 or more")
    if not 0 <= first <= last < count:
        raise DeviceError(
            f"{path}: robot {robot!r}: frames {first} to {last} are not within the {count} images"
        )
    return range(first, last + 1, step)
