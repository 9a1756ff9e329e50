"""Files with true poses, as TUM RGB-D, EuRoC, TUM VI and KITTI odometry publish them. For scores only."""

from pathlib import Path

import numpy as np

from mapweave.agent.recordings.pose_files import headings_of, read_poses
from mapweave.agent.recordings.recording import Stamps
from mapweave.agent.recordings.table_file import read_text
from mapweave.evaluation.truth import Truth
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array

EUROC_MARK = "#timestamp"
"""What the first line of a data.csv begins with."""
EUROC_COLUMNS = 8
"""Stamp, ns; x, y, z, m; quaternion w, x, y, z. More follow: velocity, biases."""
KITTI_COLUMNS = 12
"""The upper three rows of a pose's matrix."""
READ = (
    "a truth is truth.csv, TUM's groundtruth.txt, EuRoC's data.csv with orientations, or KITTI's poses/NN.txt"
)


def truth_beside(recording: Path) -> Path | None:
    """The true poses of a recording where its benchmark has them; None if there are none."""
    folder = recording if recording.is_dir() else recording.parent
    sequence = folder.resolve()
    places = [folder / "truth.csv"]
    if (folder / "rgb.txt").exists():
        places.append(folder / "groundtruth.txt")
    places += [folder / "mav0" / name / "data.csv" for name in ("state_groundtruth_estimate0", "mocap0")]
    if sequence.parent.name == "sequences":
        places.append(sequence.parent.parent / "poses" / f"{sequence.name}.txt")
    return next((place for place in places if place.exists()), None)


def read_truth(path: Path, recording: Path) -> tuple[Stamps, Array]:
    """Read true poses.

    Args:
        path: of the file.
        recording: that it is of: KITTI's poses have the times of its times.txt.

    Returns:
        (N,) stamps, ns, ascending, and (N, 3) x m, y m, heading rad.

    Raises:
        DeviceError: it is missing or wrong.
    """
    if not path.exists():
        raise DeviceError(f"{path}: no such file; without --truth nothing is scored")
    text, _ = read_text(path)
    lines = [line for line in text.splitlines() if line.strip()]
    if lines and lines[0].startswith(EUROC_MARK):
        return _euroc(path, lines[1:])
    if path.suffix == ".csv":
        truth = Truth.read(path)
        return truth.stamps_ns, np.array([pose.vector for pose in truth.poses]).reshape(-1, 3)
    if lines and len(lines[0].split()) == KITTI_COLUMNS:
        return _kitti(path, lines, recording)
    try:
        poses = read_poses(path)
    except DeviceError as error:
        raise DeviceError(f"{error}; {READ}") from None
    return poses.stamps_ns, poses.poses


def _euroc(path: Path, lines: list[str]) -> tuple[Stamps, Array]:
    rows = [line.split(",") for line in lines]
    if rows and len(rows[0]) < EUROC_COLUMNS:
        raise DeviceError(f"{path}: has no orientations; {READ}")
    try:
        # Nanoseconds since 1970 exceed what a float64 holds exactly.
        stamps = np.array([int(row[0]) for row in rows], np.int64)
    except (ValueError, OverflowError) as error:
        raise DeviceError(f"{path}: {error}") from None
    values = _table(path, [row[1:EUROC_COLUMNS] for row in rows], EUROC_COLUMNS - 1)
    if (np.diff(stamps) <= 0).any():
        raise DeviceError(f"{path}: stamps must ascend")
    return stamps, np.column_stack([values[:, :2], headings_of(values[:, [4, 5, 6, 3]])])


def _kitti(path: Path, lines: list[str], recording: Path) -> tuple[Stamps, Array]:
    """Of a camera, in the frame of the first: x right, y down, z forward."""
    values = _table(path, [line.split() for line in lines], KITTI_COLUMNS).reshape(-1, 3, 4)
    times = recording / "times.txt"
    words = read_text(times)[0].split()
    if len(words) != len(values):
        raise DeviceError(f"{path}: {len(values)} poses for the {len(words)} times of {times}")
    seconds = _table(times, [[word] for word in words], 1)[:, 0]
    stamps = np.array([round(1e9 * time) for time in seconds.tolist()], np.int64)
    headings = np.arctan2(-values[:, 0, 2], values[:, 2, 2])
    return stamps, np.column_stack([values[:, 2, 3], -values[:, 0, 3], headings])


def _table(path: Path, rows: list[list[str]], columns: int) -> Array:
    """(N, columns).

    Raises:
        DeviceError: something in it is no number, or a row is shorter or longer.
    """
    try:
        values = np.array(rows, np.float64).reshape(-1, columns)
    except ValueError as error:
        raise DeviceError(f"{path}: {error}") from None
    if not np.isfinite(values).all():
        raise DeviceError(f"{path}: all numbers must be finite")
    return values
