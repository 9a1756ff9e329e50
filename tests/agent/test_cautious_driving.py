"""Driving without proximity sensors: touches are recognised, and backed off from."""

import math

import pytest

from mapweave import Camera, Command, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.cautious_driving import (
    ALONG_EDGES,
    BACK_OFF,
    CREEP,
    SLOW,
    CautiousDriving,
    lacks_rangers,
    speed_for,
)

BODY = RobotDescription(Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3))
ROOM = 0.4
"""m ahead of the robot there is a wall."""


class Drive:
    """A robot before a wall that no sensor sees.

    Attributes:
        x: true way, m.
        fastest: largest speed at which it met the wall, m/s.
    """

    def __init__(self, bumper: bool, slips: bool, pose_known: bool = True) -> None:
        self.x = self.fastest = 0.0
        self.caution = CautiousDriving(BODY)
        self._bumper, self._slips, self._pose_known = bumper, slips, pose_known

    def run(self, wanted: float, ticks: int, most: float = SLOW) -> list[str]:
        said, moved, bumped = [], 0.0, False
        for tick in range(ticks):
            pose = Pose2(self.x) if self._pose_known else None
            self.caution.see(Observation(tick, Odometry(moved, 0.0), bumped=bumped), pose)
            said.append(self.caution.touched)
            command = self.caution.command(Command(wanted, 0.0), most)
            way = command.forward * BODY.tick
            there = min(max(self.x + way, -ROOM), ROOM)
            blocked = abs(there - self.x) < abs(way) - 1e-9
            bumped = self._bumper and blocked
            if blocked:
                self.fastest = max(self.fastest, abs(command.forward))
            moved = way if self._slips else there - self.x
            self.x = there
        return [words for words in said if words]


@pytest.mark.parametrize("wanted", [0.3, -0.3])
@pytest.mark.parametrize(("bumper", "slips", "words"), [
    (True, False, "the bumper is pressed"),
    (False, False, "the wheels stall"),
    (False, True, "the wheels turn and the image stands"),
])  # fmt: skip
def test_a_touch_is_recognised_and_backed_off_from(wanted: float, bumper: bool, slips: bool, words: str):
    drive = Drive(bumper, slips)
    said = drive.run(wanted, 45)
    assert said == [words]
    assert drive.fastest == pytest.approx(SLOW)
    assert drive.caution.heading == (0.0 if wanted > 0.0 else math.pi)
    drive.run(0.0, 30)
    assert ROOM - abs(drive.x) == pytest.approx(BACK_OFF, abs=0.02)


def test_free_driving_turning_and_starting_are_no_touches():
    drive = Drive(bumper=True, slips=False)
    assert drive.run(0.05, 60) == []
    assert drive.run(-0.15, 20) == []
    # The wheels lag behind the command.
    caution = CautiousDriving(BODY)
    for tick, way in enumerate([0.0, 0.0, 0.002, 0.004, *[0.005] * 20]):
        caution.see(Observation(tick, Odometry(way, 0.0)), Pose2(0.005 * tick))
        assert not caution.touched
        caution.command(Command(0.05, 0.0), SLOW)
    for tick in range(30):
        caution.see(Observation(tick, Odometry(0.0, 0.05)), Pose2())
        assert not caution.touched
        assert caution.command(Command(0.0, 0.5), SLOW) == Command(0.0, 0.5)


def test_without_a_pose_slipping_wheels_say_nothing():
    assert Drive(bumper=False, slips=True, pose_known=False).run(0.3, 60) == []


def test_speeds_are_limited_and_curves_stay():
    caution = CautiousDriving(BODY)
    safe = caution.command(Command(0.3, 0.6), ALONG_EDGES)
    assert safe.forward == pytest.approx(ALONG_EDGES)
    assert safe.turn / safe.forward == pytest.approx(2.0)
    assert speed_for(0.0) == CREEP
    assert speed_for(1.0) == SLOW


def test_who_drives_backs_off_himself():
    drive = Drive(bumper=True, slips=False)
    drive.run(0.3, 30)
    assert drive.caution.backing_off
    assert drive.caution.command(Command(0.2, 0.1), 0.3, follow=True) == Command(0.2, 0.1)
    assert not drive.caution.backing_off


def test_a_robot_that_is_only_carried_lacks_nothing():
    assert lacks_rangers(BODY)
    assert not lacks_rangers(RobotDescription(BODY.camera, max_forward=0.0))
    assert not lacks_rangers(RobotDescription(BODY.camera, ranger_bearings=(0.0,), ranger_reach=1.0))
