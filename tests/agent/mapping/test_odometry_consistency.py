"""Wheels against image: small slips are consistent, contradicting motions are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Odometry, Pose2
from mapweave.agent.mapping.odometry_consistency import LASTING, OdometryConsistency


def drive(steps, wheels):
    """The pose that truly comes of steps, and a dispute that heard what the wheels made of them."""
    dispute, true = OdometryConsistency(), Pose2()
    for step in steps:
        dispute.step(wheels(step))
        true = true @ step.motion()
    return dispute, true


def disputed(dispute, pose) -> bool:
    """Whether the two contradict each other when as many images as it takes show a pose."""
    for _ in range(LASTING):
        dispute.compare(pose)
    return dispute.disputed


steps = st.lists(st.builds(Odometry, st.floats(-0.03, 0.03), st.floats(-0.08, 0.08)), min_size=1, max_size=60)


@given(steps, st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))
def test_slightly_wrong_wheels_are_accepted(moves, longer, wider):
    """3 % in the way and in the turns: far worse than any wheel of the simulator."""
    dispute, true = drive(moves, lambda m: Odometry(m.forward * (1 + longer), m.turn * (1 + wider)))
    assert not disputed(dispute, true)


@pytest.mark.parametrize(("wheels", "contradict"), [
    (lambda m: m, False),
    (lambda m: Odometry(0.0, 0.0), True),  # dead encoders
    (lambda m: Odometry(m.forward, 0.0), True),  # the room seems to turn, the wheels do not
    (lambda m: Odometry(2.0 * m.forward, m.turn), True),  # wheels that spin
])  # fmt: skip
def test_wheels_and_images_that_cannot_both_be_right(wheels, contradict):
    moves = [Odometry(0.02, 0.03)] * 40
    dispute, true = drive(moves, wheels)
    assert disputed(dispute, true) == contradict
    dispute.settle()
    assert not disputed(dispute, Pose2())


def test_a_jump_of_the_encoders_is_seen_at_once_and_disputed_if_it_lasts():
    dispute, true = drive([Odometry(0.02, 0.0)] * 10, lambda m: m)
    dispute.step(Odometry(0.3, 0.0))
    for images in range(1, LASTING + 1):
        dispute.compare(true @ Pose2(0.02 * images))
        assert dispute.contradicting == images
        dispute.step(Odometry(0.02, 0.0))
    assert dispute.disputed
    assert np.isclose(true.x, 0.2)


def test_one_image_that_misleads_the_filter_is_no_dispute():
    """On KITTI 03 the car nods, one image moves the filter 0.26 m back, and the next one forth again."""
    dispute, true = drive([Odometry(0.83, 0.01)], lambda m: m)
    dispute.compare(true @ Pose2(-0.26))
    assert dispute.contradicting == 1
    dispute.step(Odometry(0.83, 0.01))
    dispute.compare(true @ Pose2(0.8))
    assert dispute.contradicting == 0
    assert not dispute.disputed


def test_a_camera_that_stands_elsewhere_on_the_robot_is_no_dispute_in_turns():
    """The camera stands 1 m further ahead than is assumed: the robot seems to go where the camera goes."""
    lever = Pose2(1.0)
    for lever_error, contradict in ((0.0, True), (1.0, False)):
        dispute, true = drive([Odometry(0.3, 0.05)] * 10, lambda m: m)
        dispute.lever_error = lever_error
        assert disputed(dispute, lever.inverse() @ true @ lever) == contradict
    dispute, true = drive([Odometry(0.3, 0.0)] * 10, lambda m: Odometry(0.5 * m.forward, 0.0))
    dispute.lever_error = 1.0
    assert disputed(dispute, true), "straight ahead it explains nothing"
