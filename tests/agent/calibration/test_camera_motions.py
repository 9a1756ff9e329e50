"""Camera motions by the wheels: against points that are projected by hand, and their small steps."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapweave.agent.calibration.camera_motions import (
    CameraMotions,
    WheelTrack,
    predict,
    robot_from_camera,
    rotations,
    slip_steps,
)
from mapweave.agent.drive_geometry import DriveGeometry, Parameter

TRUE = DriveGeometry(1.04, 0.97, 0.01, 0.3, -0.1, 0.05, 0.12, -0.03, 0.4, 0.03)


def motion(rng: np.random.Generator) -> CameraMotions:
    """Any motion."""
    return CameraMotions(
        rotations(rng.normal(0.0, 0.5, (3, 3))), rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    )


def test_a_vector_is_a_geometry():
    again = DriveGeometry.of(TRUE.vector)
    assert np.allclose(again.vector, TRUE.vector, atol=1e-15)
    assert math.isclose(math.exp(TRUE.vector[Parameter.HEIGHT]), 0.4)


@given(arrays(np.float64, (3, 6), elements=st.floats(-0.6, 0.6)), st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_steps_are_undone(step: np.ndarray, seed: int):
    at = motion(np.random.default_rng(seed))
    assert np.allclose(at.stepped(step).since(at), step, atol=1e-9)


def test_the_mount_has_its_signs():
    """To the left, down, right side low."""
    ahead, right = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    assert (robot_from_camera(0.1, 0.0, 0.0) @ ahead)[1] > 0.09
    assert (robot_from_camera(0.0, 0.1, 0.0) @ ahead)[2] < -0.09
    assert (robot_from_camera(0.0, 0.0, 0.1) @ right)[2] < -0.09
    assert np.allclose(robot_from_camera(0.0, 0.0, 0.0) @ right, [0.0, -1.0, 0.0])


def planar(x: float, y: float, turn: float) -> np.ndarray:
    """(4, 4) pose of a robot."""
    pose = np.eye(4)
    pose[:2] = [[math.cos(turn), -math.sin(turn), 0.0, x], [math.sin(turn), math.cos(turn), 0.0, y]]
    return pose


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_slip_moves_the_camera_by_the_same_step_whatever_the_motion(x: float, y: float, turn: float):
    """Against finite differences of matrices."""
    robot_from_seen = np.eye(4)
    robot_from_seen[:3, :3] = robot_from_camera(TRUE.heading, TRUE.pitch, TRUE.roll)
    robot_from_seen[:2, 3] = TRUE.forward, TRUE.left

    def moved(*slip: float) -> CameraMotions:
        robot = planar(x, y, turn) @ planar(*slip)
        second_from_first = np.linalg.inv(robot_from_seen) @ np.linalg.inv(robot) @ robot_from_seen
        return CameraMotions(
            second_from_first[None, :3, :3], second_from_first[None, :3, 3], np.zeros((1, 3))
        )

    step = 1e-6
    for column, slip in zip(slip_steps(TRUE.vector).T, step * np.eye(3), strict=True):
        assert np.allclose(moved(*slip).since(moved(0.0, 0.0, 0.0))[0] / step, column, atol=1e-4)


def test_points_are_seen_where_the_motion_says():
    """A robot on a circle at constant speeds: the pose in closed form, points transformed one by one."""
    speed, rate = 0.4, 0.5
    stamps = np.arange(0.0, 5.0, 0.05)
    reported = WheelTrack(
        stamps, speed * stamps / TRUE.wheel_scale, (rate - TRUE.drift * speed) * stamps / TRUE.turn_scale
    )
    first, last = np.array([1.0]), np.array([1.9])
    predicted = predict(TRUE.vector, reported, first, last)
    mount = robot_from_camera(TRUE.heading, TRUE.pitch, TRUE.roll)
    centre = np.array([TRUE.forward, TRUE.left, TRUE.height])
    world = np.array([[2.0, 0.5, 0.0], [3.0, -1.0, 1.0], [1.5, 1.0, 0.0]])
    seen = []
    for t in (first[0], last[0]):
        turned = rate * t
        at = speed / rate * np.array([math.sin(turned), 1.0 - math.cos(turned), 0.0])
        robot = np.array(
            [[math.cos(turned), -math.sin(turned), 0], [math.sin(turned), math.cos(turned), 0], [0, 0, 1]]
        )
        seen.append(((world - at) @ robot - centre) @ mount)
    before, after = seen
    there = before @ predicted.rotation[0].T + predicted.translation[0]
    assert np.allclose(there, after, atol=2e-4)
    on_floor = world[:, 2] == 0.0
    normalised = before / before[:, 2:]
    assert np.allclose((normalised @ predicted.floor[0])[on_floor], 1.0 / before[on_floor, 2])


def test_a_smooth_track_goes_as_far():
    rng = np.random.default_rng(0)
    stamps = np.arange(0.0, 10.0, 0.1)
    noisy = WheelTrack(stamps, 0.3 * stamps + 0.001 * rng.normal(size=100).cumsum(), 0.1 * stamps)
    smooth = noisy.smooth(0.5)
    assert abs((smooth.way[80] - smooth.way[20]) - (noisy.way[80] - noisy.way[20])) < 0.01
    assert np.allclose(smooth.turn[10:90], noisy.turn[10:90])


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.01, 1.0, 3.0])
def test_rotations_are_those_of_opencv(size: float):
    for vector in size * np.random.default_rng(1).normal(size=(20, 3)):
        assert np.allclose(rotations(vector), cv2.Rodrigues(vector)[0], atol=1e-12)


def test_a_single_pair_asks_for_the_readings_around_it():
    """Against averages of samples, within what was counted and beyond; and as among pairs of a drive."""
    rng = np.random.default_rng(2)
    stamps = np.cumsum(rng.choice([0.08, 0.1, 0.1, 0.1, 0.3], 300))
    wheels = WheelTrack(stamps, np.cumsum(rng.normal(0.02, 0.01, 300)), np.cumsum(rng.normal(0.0, 0.03, 300)))
    first = np.array([stamps[0] - 0.4, *rng.uniform(stamps[0], stamps[-1], 40), stamps[-1] - 0.3])
    last = first + rng.uniform(0.2, 1.2, len(first))
    together = wheels.between(first, last)
    width, spread = float(np.median(np.diff(stamps))), np.linspace(-0.5, 0.5, 20001)

    def counted(column: np.ndarray, time: float) -> float:
        """A count averaged about a time; it goes on at both ends as it did."""
        ends = [stamps[0] - 9.0, *stamps, stamps[-1] + 9.0]
        rates = np.diff(column)[[0, -1]] / np.diff(stamps)[[0, -1]]
        counts = [column[0] - 9.0 * rates[0], *column, column[-1] + 9.0 * rates[1]]
        return float(np.interp(time + width * spread, ends, counts).mean())

    for k, (begin, end) in enumerate(zip(first, last, strict=True)):
        alone = wheels.between(first[k : k + 1], last[k : k + 1])
        for column, parts, among_all in zip((wheels.way, wheels.turn), alone, together, strict=True):
            assert np.allclose(parts[0], among_all[k], rtol=0.0, atol=1e-12)
            assert parts.sum() == pytest.approx(counted(column, end) - counted(column, begin), abs=1e-5)
