"""Trajectories of all frames: the wheels carry on what is not localized."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from mapweave.agent.recordings.trajectory_file import BY_WHEELS, LOCALIZED, TrajectoryFile
from mapweave.hybridmap.pose import Pose2

STEP = Pose2(0.1, 0.0, 0.0)


def written(path: Path, poses: list[Pose2 | None]) -> list[str]:
    """The lines of a drive of equal steps."""
    file = TrajectoryFile(path)
    for k, pose in enumerate(poses):
        file.add(k * 10**9, STEP if k else Pose2(), pose)
    file.close()
    return path.read_text().splitlines(keepends=True)


def test_frames_before_between_and_after_are_carried_by_the_wheels(tmp_path: Path) -> None:
    at = Pose2(5.0, 1.0, 0.0)
    lines = written(tmp_path / "a.tum", [None, None, at, None, Pose2(5.3, 1.0, 0.0), None])
    assert [k for k, line in enumerate(lines) if line == BY_WHEELS] == [0, 5, 9]
    assert [k for k, line in enumerate(lines) if line == LOCALIZED] == [3, 7]
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    assert trajectory.positions_xyz[:, 0] == pytest.approx([4.8, 4.9, 5.0, 5.1, 5.3, 5.4])
    assert np.allclose(trajectory.positions_xyz[:, 1], 1.0)


def test_without_any_place_there_are_the_wheels(tmp_path: Path) -> None:
    lines = written(tmp_path / "b.tum", [None, None])
    assert lines[0] == BY_WHEELS and len(lines) == 3
    assert lines[2].startswith("1.000000000 0.100000 ")


def test_a_drive_that_is_always_localized_needs_no_comment(tmp_path: Path) -> None:
    assert len(written(tmp_path / "c.tum", [Pose2(), STEP])) == 2
