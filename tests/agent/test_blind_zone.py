"""Readings of 0 within the blind zone, against the walls of a room that the test knows."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Observation, Odometry, Pose2
from mapweave.agent.blind_zone import BlindZone, _within_turn
from tests.agent.ranged_body import BEARINGS, BODY, ROOM, rangers

DEPTH = 0.25
"""Of the blind zone, m."""
AHEAD = BEARINGS.index(0.0)
BEHIND = BEARINGS.index(-math.pi)


def sonar(pose: Pose2) -> np.ndarray:
    """(K,) m as an ultrasonic sensor gives it."""
    true = rangers(pose)
    return np.where(true < DEPTH, 0.0, true)


def drive(
    zone: BlindZone, pose: Pose2, steps: Sequence[tuple[float, float]], read=sonar
) -> tuple[Pose2, np.ndarray, np.ndarray]:
    """Drive by steps of (m, rad); returns the pose, and the last readings as read and filled in."""
    raw = filled = np.zeros(0)
    for forward, turn in steps:
        moved = Odometry(forward, turn)
        pose = pose @ moved.motion()
        raw = read(pose)
        filled = zone.fill(Observation(0, moved, proximity=raw)).proximity
    return pose, raw, filled


def test_a_wall_that_was_seen_from_farther_off_is_where_it_was():
    zone = BlindZone(BODY)
    # Ahead the wall is 1.64 m from the robot's edge.
    pose, raw, filled = drive(zone, Pose2(), [(0.03, 0.0)] * 50)
    assert raw[AHEAD] == 0.0
    assert filled[AHEAD] == pytest.approx(ROOM[1] - pose.x - BODY.radius, abs=0.03)
    # Turned around, another sensor looks at it, and knows it as well.
    pose, raw, filled = drive(zone, pose, [(0.0, math.pi / 24)] * 24)
    assert raw[BEHIND] == 0.0
    assert filled[BEHIND] == pytest.approx(ROOM[1] - pose.x - BODY.radius, abs=0.03)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.floats(0.0, 0.03), st.floats(-0.08, 0.08)), min_size=10, max_size=80),
    st.floats(-math.pi, math.pi),
)
def test_nothing_is_filled_in_that_is_farther_than_it_is(steps: list[tuple[float, float]], heading: float):
    zone, pose = BlindZone(BODY), Pose2(0.0, 0.0, heading)
    for step in steps:
        if rangers(pose @ Odometry(*step).motion()).min() < 0.02:
            break
        pose, raw, filled = drive(zone, pose, [step])
        assert (filled[raw > 0.0] == raw[raw > 0.0]).all()
        # A beam has a width, in which a corner may be nearer than on its axis.
        assert (filled[raw == 0.0] <= rangers(pose)[raw == 0.0] + 0.06).all()


def test_what_was_never_seen_may_touch():
    zone = BlindZone(BODY)
    _, raw, filled = drive(zone, Pose2(ROOM[1] - BODY.radius - 0.1, 0.0), [(0.0, math.tau / 48)] * 48)
    assert raw[AHEAD] == filled[AHEAD] == 0.0


def test_where_the_robot_has_just_been_there_is_nothing():
    zone, beside = BlindZone(BODY), np.full(len(BEARINGS), BODY.ranger_reach)
    beside[BEHIND] = 0.0

    def always(pose: Pose2) -> np.ndarray:
        return beside

    _, _, filled = drive(zone, Pose2(), [(0.01, 0.0)] * 11, always)
    assert filled[BEHIND] == pytest.approx(0.1, abs=0.011)
    # It has been all over the zone: a person has stepped up behind it.
    _, _, filled = drive(zone, Pose2(), [(0.01, 0.0)] * 40, always)
    assert filled[BEHIND] == 0.0


def test_sensors_that_measure_down_to_a_touch_are_believed():
    zone = BlindZone(BODY)
    pose, _, _ = drive(zone, Pose2(), [(0.03, 0.0)] * 54, rangers)
    assert rangers(pose)[AHEAD] < 0.03
    pose, _, _ = drive(zone, pose, [(-0.03, 0.0)] * 5, rangers)
    touched = rangers(pose)
    touched[AHEAD] = 0.0
    assert zone.fill(Observation(0, Odometry(0.0, 0.0), proximity=touched)).proximity[AHEAD] == 0.0


def test_a_robot_that_was_lifted_knows_nothing():
    zone = BlindZone(BODY)
    pose, raw, _ = drive(zone, Pose2(), [(0.03, 0.0)] * 50)
    lifted = zone.fill(Observation(0, Odometry(0.0, 0.0), proximity=raw, kidnapped=True))
    assert lifted.proximity[AHEAD] == 0.0
    assert raw[AHEAD] == 0.0
    assert pose.x == pytest.approx(1.5)


def test_robots_without_rangers_are_left_alone():
    observation = Observation(0, Odometry(0.1, 0.0))
    assert BlindZone(BODY).fill(observation) is observation


def test_an_angle_is_brought_into_one_turn_as_by_the_remainder():
    angles = np.random.default_rng(6).uniform(-15.0, 15.0, (16, 40))
    angles[0, :5] = 0.0, -1e-20, math.tau, -math.tau, np.nextafter(math.tau, 0.0)
    assert np.array_equal(_within_turn(angles.copy()), angles % math.tau)
