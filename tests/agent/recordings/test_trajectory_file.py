"""Trajectories of all frames: the wheels carry on what is not localized."""

import math
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.agent.recordings.trajectory_file import BY_WHEELS, LOCALIZED, TrajectoryFile
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.pose import Pose2
from mapweave.storage.os_errors import NO_ROOM

STEP = Pose2(0.1, 0.0, 0.0)


def written(path: Path, poses: list[Pose2 | None]) -> list[str]:
    """The lines of a drive of equal steps."""
    file = TrajectoryFile(path)
    for k, pose in enumerate(poses):
        file.add(k * 10**9, STEP if k else Pose2(), pose)
    file.close()
    return path.read_text().splitlines(keepends=True)


def test_frames_before_between_and_after_are_carried_by_the_wheels(tmp_path):
    at = Pose2(5.0, 1.0, 0.0)
    lines = written(tmp_path / "a.tum", [None, None, at, None, Pose2(5.3, 1.0, 0.0), None])
    assert [k for k, line in enumerate(lines) if line == BY_WHEELS] == [0, 5, 9]
    assert [k for k, line in enumerate(lines) if line == LOCALIZED] == [3, 7]
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    assert trajectory.positions_xyz[:, 0] == pytest.approx([4.8, 4.9, 5.0, 5.1, 5.3, 5.4])
    assert np.allclose(trajectory.positions_xyz[:, 1], 1.0)


def test_without_any_place_there_are_the_wheels(tmp_path):
    lines = written(tmp_path / "b.tum", [None, None])
    assert lines[0] == BY_WHEELS and len(lines) == 3
    assert lines[2].startswith("1.000000000 0.100000 ")


def test_a_way_that_is_moved_is_moved_to_the_place_where_it_was(tmp_path):
    """What an earlier run has written stays; so do comments and stamps."""
    path, turn = tmp_path / "d.tum", Pose2(1.0, 2.0, math.pi / 2)
    path.write_text("0.5 7.000000 0.000000 0 0 0 0.000000000 1.000000000\n")
    file = TrajectoryFile(path)
    poses = [Pose2(1.0, 0.0, 0.1), None, Pose2(2.0, 0.0, 0.2), Pose2(9.0, 0.0, 0.3)]
    for k, pose in enumerate(poses):
        if k == 3:
            file.move(WayCorrection(turn))
            file.move(WayCorrection(Pose2(0.5), 2.0))
        file.add(k * 10**9, STEP, pose)
    file.move(WayCorrection(Pose2(0.0, 5.0)))
    file.add(4 * 10**9, STEP, None)
    file.close()
    assert [line for line in path.read_text().splitlines() if line.startswith("#")] == [
        BY_WHEELS.strip(), LOCALIZED.strip(), BY_WHEELS.strip(),
    ]  # fmt: skip
    read = file_interface.read_tum_trajectory_file(path)
    assert read.timestamps == pytest.approx([0.5, 0.0, 1.0, 2.0, 3.0, 4.0])
    # (x, y) turned by a quarter is (-y, x); all that is twice as far away then.
    carried = (2.5 - 0.2 * math.sin(0.1), 11.0 + 0.2 * math.cos(0.1))
    last = (9.0 + 0.1 * math.cos(0.3), 5.0 + 0.1 * math.sin(0.3))
    there = [(7.0, 0.0), (2.5, 6.0 + 5.0), carried, (2.5, 8.0 + 5.0), (9.0, 5.0), last]
    assert read.positions_xyz[:, :2] == pytest.approx(np.array(there), abs=1e-5)
    headings = 2.0 * np.arctan2(read.orientations_quat_wxyz[:, 3], read.orientations_quat_wxyz[:, 0])
    quarter = math.pi / 2
    assert headings == pytest.approx([0.0, quarter + 0.1, quarter + 0.1, quarter + 0.2, 0.3, 0.3], abs=1e-6)


def test_a_drive_that_is_always_localized_needs_no_comment(tmp_path):
    assert len(written(tmp_path / "c.tum", [Pose2(), STEP])) == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_named_with_the_file_and_what_to_do():
    """An error of the system without a file was all that a person read."""
    words = re.escape(f"/dev/full: cannot be written ({NO_ROOM})")
    file = TrajectoryFile(Path("/dev/full"))
    with pytest.raises(InvalidFile, match=words):
        for stamp_ns in range(1000):
            file.add(stamp_ns, Pose2(), Pose2())
    with suppress(InvalidFile):
        file.close()
