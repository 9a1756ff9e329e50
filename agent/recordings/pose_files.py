"""Odometry in files: stamped poses as CSV with a header, or lines as TUM's benchmark and evo write them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from mapweave.agent.recordings.recording import StampedPoses
from mapweave.agent.ros_messages.values import heading_of
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array
from mapweave.storage.atomic_file import read_whole

CSV_COLUMNS = ("stamp_s", "x_m", "y_m", "heading_rad")


def read_poses(path: Path) -> StampedPoses:
    """Read poses.

    A `.csv` has the columns stamp_s, x_m, y_m and heading_rad. Any other file has lines of
    `stamp x y z qx qy qz qw`, s and m, z up; lines that begin with # are comments.

    Raises:
        DeviceError: the file is missing or wrong.
    """
    try:
        text = read_whole(path).decode("utf-8")
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: {error}") from None
    rows = _csv(path, text) if path.suffix == ".csv" else _tum(path, text)
    if len(rows) < 2 or not np.isfinite(rows).all():
        raise DeviceError(f"{path}: {len(rows)} poses; there must be two or more, all finite")
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    rows = rows[np.append(True, np.diff(rows[:, 0]) > 0)]
    return StampedPoses(np.array([round(1e9 * t) for t in rows[:, 0]], np.int64), rows[:, 1:])


def _csv(path: Path, text: str) -> Array:
    reader = csv.DictReader(text.splitlines())
    missing = [name for name in CSV_COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise DeviceError(f"{path}: no column {missing[0]!r}; poses have {', '.join(CSV_COLUMNS)}")
    try:
        return np.array([[float(row[name]) for name in CSV_COLUMNS] for row in reader]).reshape(-1, 4)
    except (TypeError, ValueError) as error:
        raise DeviceError(f"{path}: line {reader.line_num}: {error}") from None


def _tum(path: Path, text: str) -> Array:
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            stamp, x, y, _, qx, qy, qz, qw = map(float, words)
        except ValueError:
            raise DeviceError(f"{path}: line {number}: a pose is `stamp x y z qx qy qz qw`") from None
        rows.append((stamp, x, y, heading_of(qx, qy, qz, qw)))
    return np.array(rows).reshape(-1, 4)
