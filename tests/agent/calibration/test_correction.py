"""A level lens against a camera that is tilted by hand, and odometry that is late."""

import numpy as np
import pytest

from mapweave.agent.calibration.camera_motions import robot_from_camera
from mapweave.agent.calibration.correction import OdometryCorrection, corrected, frame_change, geometry_of
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from tests.agent.calibration.room_drive import CAMERA

BENT = (-0.2, 0.05, 0.001, -0.001, 0.0)
TRUE = DriveGeometry(forward=0.2, heading=0.04, pitch=-0.06, roll=0.02, height=0.3)


def test_a_level_camera_sees_what_the_tilted_one_does():
    """Points projected by the tilted pinhole lie, undistorted, where the level camera projects them."""
    robot = RobotDescription(CAMERA)
    description, lens = corrected(robot, TRUE)
    points = np.array([[2.0, 0.3, 0.1], [3.0, -0.8, 1.0], [1.5, 0.0, 0.4], [6.0, 1.0, 0.0]])
    mount = robot_from_camera(TRUE.heading, TRUE.pitch, TRUE.roll)
    local = (points - [TRUE.forward, 0.0, TRUE.height]) @ mount
    raw = local[:, :2] / local[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    assert np.allclose(lens.undistort(raw), description.camera.project(points), atol=1e-9)
    # Images stay where they are: what is in the middle stays within a pixel or so.
    middle = np.array([[CAMERA.cx, CAMERA.cy]])
    assert np.linalg.norm(lens.undistort(middle) - middle) < 2.0


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BENT])
def test_the_level_lens_goes_both_ways(distortion: tuple[float, float, float, float, float]):
    _, lens = corrected(RobotDescription(CAMERA, distortion), TRUE)
    raw = np.random.default_rng(0).uniform(20, 220, (50, 2))
    assert np.allclose(lens.distort(lens.undistort(raw)), raw, atol=1e-3)


def test_another_geometry_moves_the_robots_frame_and_not_the_camera():
    """One point is in one pixel of the image, in whichever frame of the robot it is given."""
    old = DriveGeometry(forward=0.05, heading=-0.02, pitch=0.03, height=0.3)
    new = DriveGeometry(forward=0.75, heading=0.07, pitch=0.03, height=0.3)
    in_old = np.array([[2.0, 0.3, 0.3], [3.0, -0.8, 0.3], [1.5, 0.0, 0.3], [6.0, 1.0, 0.3]])
    in_new = frame_change(old, new).inverse().apply(in_old)
    raw = []
    for geometry, points in ((old, in_old), (new, in_new)):
        description, lens = corrected(RobotDescription(CAMERA, BENT), geometry)
        raw.append(lens.distort(description.camera.project(points)))
    assert np.abs(raw[0] - raw[1]).max() < 0.5, "pitch is about an axis that has turned"


def test_a_geometry_without_angles_changes_no_lens():
    description, lens = corrected(RobotDescription(CAMERA, BENT), DriveGeometry(forward=0.5, height=0.3))
    assert type(lens).__name__ == "Lens"
    assert (description.camera.mount_forward, description.camera.cx) == (0.5, CAMERA.cx)


def test_the_cameras_mount_is_the_geometrys():
    robot = RobotDescription(CAMERA, geometry=DriveGeometry(pitch=0.1, forward=9.0))
    assert geometry_of(robot) == DriveGeometry(
        pitch=0.1, forward=CAMERA.mount_forward, height=CAMERA.mount_height
    )


def test_late_odometry_is_made_good():
    """The wheels' way at t + delay, of a speed that changes evenly."""
    correction, delay, dt = OdometryCorrection(), 0.04, 0.1
    geometry = DriveGeometry(wheel_scale=1.1, turn_scale=0.9, drift=0.02, left=0.1, delay=delay)
    stamps = dt * np.arange(1, 60)
    # What is counted at a reading's stamp is 0.15 t^2; turns 0.05 t^2.
    way, turn = 0.15 * stamps**2, 0.05 * stamps**2
    total_way = total_turn = 0.0
    for k in range(1, len(stamps)):
        odometry = Odometry(float(way[k] - way[k - 1]), float(turn[k] - turn[k - 1]))
        given = correction.step(Observation(round(stamps[k] * 1e9), odometry), geometry).odometry
        if k > 2:
            total_turn += given.turn
            total_way += given.forward + geometry.left * given.turn
    begin, end = stamps[2] + delay, stamps[-1] + delay
    want_way = 1.1 * 0.15 * (end**2 - begin**2)
    assert total_way == pytest.approx(want_way, abs=0.005)
    assert total_turn == pytest.approx(0.9 * 0.05 * (end**2 - begin**2) + 0.02 * want_way, abs=0.003)


def test_late_odometry_of_a_robot_that_drives_already_is_no_jump():
    """At a constant speed no delay shows, from the first step on."""
    correction = OdometryCorrection()
    for k in range(1, 5):
        observation = Observation(k * 100_000_000, Odometry(0.9, 0.02))
        given = correction.step(observation, DriveGeometry(delay=0.05)).odometry
        assert (given.forward, given.turn) == pytest.approx((0.9, 0.02))


def test_odometry_without_errors_stays_as_it_is():
    correction = OdometryCorrection()
    for k in range(1, 5):
        observation = Observation(k * 100_000_000, Odometry(0.1 * k, 0.01))
        assert correction.step(observation, DriveGeometry()) is observation
