"""A node is mapped, then the robot stands somewhere else: does it know where, and does it know when not?"""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapweave import Observation, Odometry, Pose2
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.registration.recognition import recognise
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from tests.quick import first_quick

CENTIMETRES_3, DEGREE = 0.03, math.radians(1.0)


def located(walls, description, node, world_from_robot, seed=0) -> NodeLocalizer:
    """A localizer that has recognised the node from somewhere."""
    lens = Lens(description.camera, description.distortion)
    image = walls.render(world_from_robot)
    features = Sift(lens).extract(image)
    recognition = recognise(node, features.view(description.camera), None, np.random.default_rng(seed))
    assert recognition is not None
    return NodeLocalizer(description, lens, node, image, features, recognition)


def off(localizer: NodeLocalizer, true: Pose2) -> tuple[float, float]:
    """The node's view was taken at the world's origin."""
    mean = localizer.pose.mean
    return mean.distance(true), abs((mean.inverse() @ true).heading)


STARTS = [Pose2(0.25, -0.1, 0.08), Pose2(-0.3, 0.15, -0.12), Pose2(0.1, 0.3, -0.2), Pose2(0.4, 0.0, 0.0)]


@pytest.mark.parametrize("start", STARTS)
def test_the_robots_pose(walls, description, node, start):
    localizer = located(walls, description, node, start)
    distance, angle = off(localizer, start)
    assert distance < CENTIMETRES_3
    assert angle < DEGREE
    assert localizer.in_sight
    assert localizer.pose.mahalanobis2(start) < 25
    # What it says it sees is where the node's landmarks really are in the image.
    points = start.inverse().apply(node.points_in_robot[localizer.visible])
    assert np.median(np.linalg.norm(description.camera.project(points) - localizer.pixels, axis=1)) < 2.0


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("slip", first_quick([0.03, 0.0], 1))
def test_the_pose_after_a_drive(walls, description, node, start, slip):
    """20 frames of curves; with slip the wheels say 3 % too much, which the landmarks must mend."""
    localizer = located(walls, description, node, start)
    pose = start
    for tick in range(20):
        moved = Odometry(0.02 * math.cos(0.4 * tick), 0.02 * math.sin(0.3 * tick))
        pose = pose @ moved.motion()
        result = Odometry(moved.forward * (1 + slip), moved.turn * (1 + slip))
        localizer.step(Observation(tick, result, walls.render(pose)))
    assert localizer.in_sight
    distance, angle = off(localizer, pose)
    assert distance < CENTIMETRES_3
    assert angle < DEGREE
    assert localizer.pose.mahalanobis2(pose) < 25


def test_frames_without_an_image_are_driven_by_the_wheels(walls, description, node):
    pose = STARTS[0]
    localizer = located(walls, description, node, pose)
    begin, sigma = localizer.pose.mean, np.trace(localizer.pose.covariance)
    expected = begin
    for tick in range(5):
        moved = Odometry(-0.02, 0.03)
        pose, expected = pose @ moved.motion(), expected @ moved.motion()
        localizer.step(Observation(tick, moved, None))
    assert np.allclose(localizer.pose.mean.vector, expected.vector, atol=1e-6)
    assert np.trace(localizer.pose.covariance) > sigma
    localizer.step(Observation(9, Odometry(0.0, 0.0), walls.render(pose)))
    assert localizer.in_sight, "and the landmarks are found again where they are expected"
    assert off(localizer, pose)[0] < CENTIMETRES_3


@pytest.mark.parametrize("what", ["turned away", "lights out", "covered"])
def test_it_reports_when_no_landmark_is_visible(walls, description, node, what):
    localizer = located(walls, description, node, STARTS[0])
    pose = STARTS[0]
    for tick in range(12):
        moved = Odometry(0.0, 0.12 if what == "turned away" else 0.0)
        pose = pose @ moved.motion()
        image = walls.render(pose)
        if what == "lights out":
            image = np.full_like(image, 3)
        if what == "covered":
            image = np.random.default_rng(tick).integers(0, 255, image.shape).astype(np.uint8)
        localizer.step(Observation(tick, moved, image))
        if not localizer.in_sight:
            break
    assert not localizer.in_sight
    assert len(localizer.visible) < 4


def test_moving_landmarks_are_dropped(walls, description, node):
    """The picture that shows less is carried away: its landmarks are dropped, and the pose stays."""
    pose = STARTS[0]
    localizer = located(walls, description, node, pose)
    on_near = walls.depth_at(Pose2(), node.landmarks.pixels[localizer.visible]) < 2.5
    lesser = 1 if on_near.mean() < 0.5 else 0
    mine = on_near if lesser == 1 else ~on_near
    assert 4 < mine.sum() < 0.45 * len(mine)
    moving, staying = localizer.visible[mine], localizer.visible[~mine]
    walking = type(walls)()
    for tick in range(12):
        picture, x, y, z, width = walking.walls[lesser]
        walking.walls[lesser] = (picture, x, y + 0.02, z, width)
        localizer.step(Observation(tick, Odometry(0.0, 0.0), walking.render(pose)))
    assert localizer.in_sight
    assert off(localizer, pose)[0] < CENTIMETRES_3
    assert np.isin(moving, localizer.visible).mean() < 0.1
    assert np.isin(staying, localizer.visible).mean() > 0.7


def test_the_cameras_lens_is_taken_into_account(walls, description, node):
    """The same pose through a lens that bends lines: the image is bent here by hand."""
    bent = replace(description, distortion=(-0.12, 0.02, 0.0, 0.0, 0.0))
    lens, pose = Lens(bent.camera, bent.distortion), STARTS[0]
    rows, columns = np.mgrid[0:240, 0:320].astype(np.float64)
    straight = lens.undistort(np.column_stack([columns.ravel(), rows.ravel()])).reshape(240, 320, 2)
    image = cv2.remap(walls.render(pose), straight.astype(np.float32), None, cv2.INTER_CUBIC)
    features = Sift(lens).extract(image)
    recognition = recognise(node, features.view(bent.camera), None, np.random.default_rng(0))
    assert recognition is not None
    localizer = NodeLocalizer(bent, lens, node, image, features, recognition)
    localizer.step(Observation(1, Odometry(0.0, 0.0), image))
    distance, angle = off(localizer, pose)
    assert distance < CENTIMETRES_3
    assert angle < DEGREE
