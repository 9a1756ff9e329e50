"""Images between keyframes: found by what is followed of a keyframe, however the camera is held."""

import math

import cv2
import numpy as np
import pytest

from mapweave.agent.recordings.pose_files import read_poses
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import CODE_BYTES, Landmarks
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.photographs import Stretch
from mapweave.visual_trajectory import FOUND, INTERPOLATED, TrackedImage, trajectory_of, tum_lines

CAMERA = Camera(640, 480, 500.0, 505.0, 318.0, 241.0, mount_height=1.4, mount_forward=0.2)
NODES = (Pose2(2.0, 1.0, 0.4), Pose2(2.6, 1.3, 0.5))
"""In the map: of the camera, as a walk has no robot."""
COUNT = 60


def landmarks_of(rng: np.random.Generator) -> Landmarks:
    pixels = rng.uniform((20, 20), (620, 460), (COUNT, 2)).astype(np.float32)
    depths = rng.uniform(2.0, 8.0, COUNT).astype(np.float32)
    return Landmarks(pixels, np.zeros((COUNT, CODE_BYTES), np.uint8), depths, 0.1 * depths)


def seen_from(landmarks: Landmarks, way: Pose2, tilt: tuple[float, float], rise: float) -> Array:
    """(N, 2) px of landmarks of a node, from a camera that has moved, is tilted and held higher."""
    points = CAMERA.back_project(landmarks.pixels, landmarks.depths) - [CAMERA.mount_forward, 0.0, 0.0]
    points[:, :2] = way.inverse().apply(points[:, :2])
    rays = np.column_stack([-points[:, 1], CAMERA.mount_height + rise - points[:, 2], points[:, 0]])
    turned = rays @ cv2.Rodrigues(np.array([tilt[0], 0.0, tilt[1]]))[0].T
    return turned[:, :2] / turned[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]


@pytest.fixture
def stretch() -> Stretch:
    rng = np.random.default_rng(7)
    features = [rng.permutation(COUNT + 15)[:COUNT] for _ in NODES]
    return Stretch(list(NODES), [landmarks_of(rng) for _ in NODES], features, [])


def followed(stretch: Stretch, k: int, stamp_ns: int, seen: Array) -> TrackedImage:
    pixels = np.full((COUNT + 15, 2), np.nan, np.float32)
    pixels[stretch.features[k]] = seen
    return TrackedImage(stamp_ns, pixels)


def test_a_camera_that_is_tilted_and_held_higher_is_placed_upright(stretch: Stretch):
    """A third of the points are followed wrongly."""
    rng, ways = np.random.default_rng(3), [Pose2(0.2, 0.1, 0.05), Pose2(0.4, -0.1, -0.1)]
    images = []
    for n, way in enumerate(ways):
        seen = seen_from(stretch.landmarks[0], way, (0.08, -0.05), 0.1) + rng.normal(0.0, 0.5, (COUNT, 2))
        seen[::3] += rng.uniform(15.0, 60.0, (COUNT // 3, 2))
        images.append(followed(stretch, 0, 10 + n, seen))
    poses = trajectory_of(stretch, [0, 100], [images, []], CAMERA)
    assert [one.stamp_ns for one in poses] == [0, 10, 11, 100] and all(one.found for one in poses)
    assert [poses[0].map_from_robot, poses[-1].map_from_robot] == list(NODES)
    for one, way in zip(poses[1:3], ways, strict=True):
        off = (NODES[0] @ way).inverse() @ one.map_from_robot
        assert math.hypot(off.x, off.y) < 0.03 and abs(off.heading) < 0.01


def test_images_without_features_are_interpolated_and_said_to_be(stretch: Stretch, tmp_path):
    nothing = np.full((COUNT, 2), np.nan)
    wrong = np.random.default_rng(1).uniform((0, 0), (640, 480), (COUNT, 2))
    images = [followed(stretch, 0, 25, nothing), followed(stretch, 0, 50, wrong)]
    after = [followed(stretch, 1, 120, nothing)]
    poses = trajectory_of(stretch, [0, 100], [images, after], CAMERA)
    assert [(one.stamp_ns, one.found) for one in poses] == [(0, True), (25, False), (50, False), (100, True)]
    way = NODES[0].inverse() @ NODES[1]
    middle = NODES[0].inverse() @ poses[2].map_from_robot
    assert middle.vector == pytest.approx(way.vector / 2)
    (tmp_path / "walk.tum").write_text(text := tum_lines(poses))
    lines = text.splitlines(keepends=True)
    assert (lines[1], lines[4]) == (INTERPOLATED, FOUND) and len(lines) == 6
    assert len(read_poses(tmp_path / "walk.tum").poses) == 4
