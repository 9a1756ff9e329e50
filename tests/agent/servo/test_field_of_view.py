"""The slack against brute-force projection."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapweave import Camera, RobotDescription
from mapweave.agent.servo.field_of_view import FieldOfView
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2

Seen = Callable[[Camera, Pose2, Array], NDArray[np.bool_]]
poses = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3.1, 3.1))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pose_vector=poses, seed=st.integers(0, 10_000), forward=st.sampled_from([0.0, 0.1]))
def test_the_margin_counts_visible_landmarks(
    pose_vector: tuple[float, float, float], seed: int, forward: float, robot: RobotDescription, seen: Seen
):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -2, -0.5], [4, 2, 1.5], (10, 3))
    camera = replace(robot.camera, mount_forward=forward)
    pose = Pose2(*pose_vector)
    count = int(seen(camera, pose, points).sum())
    for least in (1, 4, 7):
        slack = float(FieldOfView(points, camera, least).slack(pose.vector))
        if abs(slack) > 1e-6:  # a landmark on the very border is neither
            assert (slack >= 0) == (count >= least)


@given(pose_vector=poses, turn=st.floats(-0.3, 0.3))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_slack_changes_no_faster_than_the_heading(
    pose_vector: tuple[float, float, float], turn: float, robot: RobotDescription
):
    points = np.random.default_rng(1).uniform([1, -2, 0], [5, 2, 0.5], (8, 3))
    field = FieldOfView(points, robot.camera)
    turned = np.array([pose_vector[0], pose_vector[1], pose_vector[2] + turn])
    difference = field.slack(turned) - field.slack(np.array(pose_vector))
    assert abs(float(difference)) <= abs(turn) + 1e-9


def test_fewer_landmarks_are_a_stricter_field(robot: RobotDescription):
    rng = np.random.default_rng(3)
    field = FieldOfView(rng.uniform([1, -2, 0], [5, 2, 0.5], (60, 3)), robot.camera)
    some = field.spread(20)
    where = rng.uniform([-2, -2, -1], [0, 2, 1], (500, 3))
    assert some.count == 20
    assert (some.slack(where) <= field.slack(where) + 1e-12).all()


def test_too_few_landmarks_are_never_enough(robot: RobotDescription):
    assert float(FieldOfView(np.array([[2.0, 0.0, 0.3]]), robot.camera).slack(np.zeros(3))) < 0
    assert float(FieldOfView(np.zeros((0, 3)), robot.camera).slack(np.zeros(3))) < 0


@pytest.mark.parametrize("points", [np.zeros((3, 2)), np.full((3, 3), np.nan)])
def test_bad_landmarks_are_refused(points: Array, robot: RobotDescription):
    with pytest.raises(InvalidValue):
        FieldOfView(points, robot.camera)
