"""Trajectories as TUM's benchmark and evo read them: `stamp x y z qx qy qz qw`, s and m, one pose a line."""

from __future__ import annotations

import math
from pathlib import Path

from mapweave.hybridmap.pose import Pose2


def tum_line(stamp_ns: int, pose: Pose2) -> str:
    """One pose. The stamp keeps its nanoseconds, which a float64 would not."""
    half = pose.heading / 2
    seconds = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
    return f"{seconds} {pose.x:.6f} {pose.y:.6f} 0 0 0 {math.sin(half):.9f} {math.cos(half):.9f}\n"


class TrajectoryFile:
    """Writes poses as they come; what was there before is kept."""

    def __init__(self, path: Path) -> None:
        """Begin or go on.

        Raises:
            OSError: it cannot be written.
        """
        self._file = path.open("a", encoding="ascii")

    def add(self, stamp_ns: int, pose: Pose2) -> None:
        """Write one."""
        self._file.write(tum_line(stamp_ns, pose))

    def close(self) -> None:
        """Finish the file."""
        self._file.close()
