"""Odometry in files: stamped poses as CSV with a header, or lines as TUM's benchmark and evo write them."""

import csv
import math
from pathlib import Path

import numpy as np

from mapweave.agent.recordings.recording import StampedPoses, stamps_of
from mapweave.agent.recordings.table_file import read_text, rows_of
from mapweave.agent.ros_messages.values import heading_of
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array

LEVEL = 0.5
"""An axis of length 1 is up if its tip is higher: that of a camera that looks up by 30 degrees is not."""
STEEP = 0.5
"""No floor rises by more, as a share of the largest of the three extents of a drive."""
CSV_COLUMNS = ("stamp_s", "x_m", "y_m", "heading_rad")


def read_poses(path: Path) -> StampedPoses:
    """Read poses.

    A `.csv` has the columns stamp_s, x_m, y_m and heading_rad. Any other file has lines of
    `stamp x y z qx qy qz qw`, s and m, z up, of a robot or of its camera; lines that begin with # are
    comments. Poses in the frame of a camera are turned until z is up, and `notes` says so. A last line
    without its end is left out. A damaged line ends the poses. Poses are sorted by time.

    Raises:
        DeviceError: the file is missing or wrong.
    """
    text, no_text = read_text(path)
    turned = ""
    if path.suffix == ".csv":
        rows, damage = _csv(path, text)
    else:
        rows, damage, turned = _tum(path, text)
    damage = damage or no_text
    if len(rows) < 2:
        raise DeviceError(damage or f"{path}: {len(rows)} poses; there must be two or more")
    back, rows = np.diff(rows[:, 0]) < 0, rows[np.argsort(rows[:, 0], kind="stable")]
    new = np.append(True, np.diff(rows[:, 0]) > 0)
    notes = [turned] if turned else []
    if back.any():
        often = "once" if back.sum() == 1 else f"{int(back.sum())} times"
        notes.append(
            f"{path}: stamps go back {often}, first at pose {int(back.argmax()) + 1}: sorted by time"
        )
    if not new.all():
        notes.append(f"{path}: {int((~new).sum())} poses have the stamp of another one: left out")
    rows = rows[new]
    stamps = stamps_of(path, rows[:, 0])
    damage = f"{damage}; the poses before it are used" if damage else ""
    return StampedPoses(stamps, rows[:, 1:], damage, tuple(notes))


def _csv(path: Path, text: str) -> tuple[Array, str]:
    reader = rows_of(path, _whole_lines(text), CSV_COLUMNS)
    rows, damage = list[list[float]](), ""
    try:
        for row in reader:
            rows.append(_finite([float(row[name]) for name in CSV_COLUMNS]))
    except (TypeError, ValueError, csv.Error) as error:
        damage = f"{path}: line {reader.line_num}: {error}"
    return np.array(rows).reshape(-1, 4), damage


def _tum(path: Path, text: str) -> tuple[Array, str, str]:
    rows, damage = list[list[float]](), ""
    for number, line in enumerate(_whole_lines(text), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = _finite(list(map(float, words)))
            _, _, _, _, qx, qy, qz, qw = row
        except ValueError as error:
            why = error if "finite" in str(error) else "a pose is `stamp x y z qx qy qz qw`"
            damage = f"{path}: line {number}: {why}"
            break
        if not any((qx, qy, qz, qw)):
            damage = f"{path}: line {number}: a quaternion of zeros is none"
            break
        rows.append(row)
    table = np.array(rows).reshape(-1, 8)
    if not _in_camera_frame(table[:, 1:4], table[:, 4:]):
        return np.column_stack([table[:, :3], headings_of(table[:, 4:])]), damage, ""
    x, y, z, w = table[:, 4:].T
    headings = np.arctan2(-2.0 * (x * z + w * y), w * w + z * z - x * x - y * y)
    note = f"{path}: poses in the frame of a camera (x right, y down, z ahead): turned until z is up"
    return np.column_stack([table[:, 0], table[:, 3], -table[:, 1], headings]), damage, note


def _in_camera_frame(positions: Array, quaternions: Array) -> bool:
    """Whether poses are in the frame of their first image, as ORB-SLAM writes them.

    Where z is up, a floor is many times as wide as it is high. In that frame z is a way along it, and turns
    are about y, so that the y axes of the poses stay.
    """
    if len(positions) < 2:
        return False
    extents = np.ptp(positions, axis=0)
    x, y, z, w = quaternions.T
    stays = (w * w + y * y - x * x - z * z) / (quaternions**2).sum(axis=1)
    return bool(extents[2] > STEEP * extents.max() and np.median(stays) > LEVEL)


def headings_of(quaternions: Array) -> Array:
    """Headings of poses in a frame whose z is up, by the axis that is ahead.

    That is x where z of most poses is up, as of robots (REP 103). Else it is z, as of a camera (x right, y
    down) and of EuRoC's IMU (x up): TUM's and EuRoC's true poses are such.

    Args:
        quaternions: (N, 4) x, y, z, w, of any length but zero.

    Returns:
        (N,) rad.
    """
    x, y, z, w = quaternions.T
    up = (w * w + z * z - x * x - y * y) / (quaternions**2).sum(axis=1)
    if not len(up) or np.median(up) > LEVEL:
        return np.array([heading_of(*row) for row in quaternions.tolist()])
    return np.asarray(np.arctan2(y * z - w * x, x * z + w * y))


def _whole_lines(text: str) -> list[str]:
    """Without what follows the last line's end: of a file that was cut off, a number may lack digits."""
    return text[: text.rfind("\n") + 1].splitlines()


def _finite(values: list[float]) -> list[float]:
    if not all(map(math.isfinite, values)):
        raise ValueError("all numbers must be finite")
    return values
