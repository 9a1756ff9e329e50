"""A carried robot that is lost begins a new map after a few seconds, and the two are joined later."""

from collections.abc import Iterator

import numpy as np
import pytest

from mapweave import Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.settings import AgentSettings
from mapweave.evaluation.merging import changes
from mapweave.mapserver.merging.merger import Merger
from tests.agent.calibration.room_drive import CAMERA, drive, render

FIRST, LAST = 150, 250
"""Images of the first map. The robot is then carried to where image 0 is, and comes past them again."""


STANDING = 30
"""Ticks for which it stands where it was put down: as long as the robot needs to notice."""


class CutDrive:
    """A drive out of whose middle a person has carried the robot to its beginning, unseen by the wheels."""

    def __init__(self) -> None:
        run = drive(np.random.default_rng(0), DriveGeometry(forward=0.08, height=0.25), 25.0)
        images, poses = render(run), [Pose2(*pose) for pose in run.poses]
        self._observations = self._sensed(images, poses)
        self.drives_on = LAST - FIRST + STANDING

    @staticmethod
    def _sensed(images: list[np.ndarray], poses: list[Pose2]) -> Iterator[Observation]:
        order = [*range(FIRST, LAST), *[0] * STANDING, *range(LAST)]
        for tick, k in enumerate(order):
            motion = Pose2() if k in (0, FIRST) else poses[k - 1].inverse() @ poses[k]
            odometry = Odometry(float(np.hypot(motion.x, motion.y)), motion.heading)
            yield Observation((tick + 1) * 100_000_000, odometry, images[k])

    def describe(self) -> RobotDescription:
        return RobotDescription(CAMERA, axle=0.25)

    def sense(self) -> Observation | None:
        return next(self._observations, None)


@pytest.mark.slow
def test_a_lost_robot_begins_a_new_map_that_is_joined_to_the_old_one():
    robot, merger, began = CutDrive(), Merger(), dict[int, int]()
    for tick, made in enumerate(changes("r0", robot, AgentSettings())):  # type: ignore[arg-type]
        for change in made:
            began.setdefault(change.map.epoch, tick)
            merger.on_change(change)
    assert sorted(began) == [1, 2]
    # Six seconds of search, and up to three more to the first node of the new map.
    assert robot.drives_on < began[2] < robot.drives_on + 90
    merged = merger.merged()
    assert len(merged.components) == 1
