"""A drive past walls, written by hand in every format that is read."""

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave import Camera, Pose2
from tests.agent.conftest import CAMERA

COUNT = 9
BEGUN_NS = 1_700_000_000_000_000_000
"""A stamp that a float64 does not hold exactly."""
STEP_NS = 200_000_000


@dataclass(frozen=True)
class Drive:
    """What a robot saw, and where it thought to be.

    Attributes:
        images: (H, W) grey each.
        stamps_ns: of the images.
        poses: odometry at the stamps.
        camera: that took the images.
    """

    images: list[NDArray[np.uint8]]
    stamps_ns: list[int]
    poses: list[Pose2]
    camera: Camera

    @property
    def increments(self) -> NDArray[np.float64]:
        """(N, 2) forward and turn since the image before: a chord at half the turn."""
        rows = [(0.0, 0.0)]
        for before, after in pairwise(self.poses):
            step = before.inverse() @ after
            rows.append(
                (step.x * math.cos(step.heading / 2) + step.y * math.sin(step.heading / 2), step.heading)
            )
        return np.array(rows)


@pytest.fixture(scope="session")
def drive(walls) -> Drive:
    """A curve, whose heading passes half a turn."""
    pose, poses, images = Pose2(3.0, -1.0, math.pi - 0.05), [], []
    for _ in range(COUNT):
        poses.append(pose)
        images.append(walls.render(Pose2(3.0, -1.0, math.pi - 0.05).inverse() @ pose))
        pose = pose @ Pose2(0.03, 0.0, 0.02)
    return Drive(images, [BEGUN_NS + k * STEP_NS for k in range(COUNT)], poses, CAMERA)


@pytest.fixture
def poses_file(drive: Drive, tmp_path: Path) -> Path:
    """The odometry at other stamps than the images', as evo writes them: it ends before the last image."""
    lines = ["# stamp x y z qx qy qz qw"]
    fine = [Pose2(*row) for row in between(drive.poses, 4)]
    for k, pose in enumerate(fine[:-1]):
        at, half = drive.stamps_ns[0] + k * STEP_NS // 4, pose.heading / 2
        seconds = f"{at // 10**9}.{at % 10**9:09d}"
        lines.append(f"{seconds} {pose.x!r} {pose.y!r} 0 0 0 {math.sin(half)!r} {math.cos(half)!r}")
    path = tmp_path / "odometry.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def between(poses: list[Pose2], parts: int) -> list[tuple[float, float, float]]:
    """Poses on the straight lines between others, so many to each, and the last one."""
    out = []
    for a, b in pairwise(poses):
        turn = math.remainder(b.heading - a.heading, math.tau)
        for n in range(parts):
            share = n / parts
            out.append((a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), a.heading + share * turn))
    return [*out, (poses[-1].x, poses[-1].y, poses[-1].heading)]
