"""Where the camera truly was: truth.csv. For scores only."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.hybridmap.pose import Pose2

COLUMNS = ("stamp_s", "x_m", "y_m", "heading_rad")


@dataclass(frozen=True)
class Truth:
    """Where the camera was.

    Attributes:
        stamps_ns: (N,) ascending.
        poses: one each.
    """

    stamps_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    poses: list[Pose2]

    @classmethod
    def read(cls, path: Path) -> Truth:
        """Read a truth.csv; one that is missing is empty.

        Raises:
            DeviceError: it is there, but wrong.
        """
        if not path.exists():
            return cls(np.zeros(0, np.int64), [])
        try:
            with path.open(newline="") as file:
                rows = [[float(row[name]) for name in COLUMNS] for row in csv.DictReader(file)]
            poses = [Pose2(x, y, heading) for _, x, y, heading in rows]
            stamps = np.array([round(row[0] * 1e9) for row in rows], np.int64)
        except KeyError as missing:
            raise DeviceError(f"{path}: no column {missing.args[0]!r}") from None
        except (OSError, ValueError, TypeError, OverflowError, csv.Error, InvalidValue) as error:
            raise DeviceError(f"{path}: {error}") from None
        if (np.diff(stamps) <= 0).any():
            raise DeviceError(f"{path}: stamps must ascend")
        return cls(stamps, poses)

    def at(self, stamp_ns: int) -> Pose2 | None:
        """The pose at a stamp, if there is one within a millisecond."""
        if not self.poses:
            return None
        nearest = int(np.abs(self.stamps_ns - stamp_ns).argmin())
        return self.poses[nearest] if abs(int(self.stamps_ns[nearest]) - stamp_ns) <= 1_000_000 else None

    def robot_at(self, stamp_ns: int, camera: Camera) -> Pose2 | None:
        """`world_from_robot` at a stamp, of a robot with this camera, if the camera's pose is known there.

        The robot's origin is on its axle. Where calibration finds the camera further ahead than declared, the
        axle is another point, and a map of it is not to be compared with where the camera was.
        """
        pose = self.at(stamp_ns)
        return None if pose is None else pose @ Pose2(-camera.mount_forward)
