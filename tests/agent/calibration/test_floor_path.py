"""The wheels' scale by a floor that is no plane, and heights over a way against hand-made ones."""

import math

import numpy as np
import pytest

from mapweave.agent.calibration.camera_motions import ROBOT_FROM_LEVEL, CameraMotions, WheelTrack, rotations
from mapweave.agent.calibration.estimator import Estimator
from mapweave.agent.calibration.floor_path import FOLLOWED, DrivenStep, follow, heights_over
from mapweave.agent.calibration.image_pairs import sigma_of
from mapweave.agent.calibration.pair_information import ImagePair
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.hybridmap.pose import Array
from tests.agent.calibration.room_drive import CAMERA
from tests.quick import first_quick

HEIGHT = 0.25
SPEED, PAIR_S = 0.5, 0.4
DECLARED = DriveGeometry(height=HEIGHT)


def on_road(distance: Array, aside: Array, above: Array, radius: float) -> Array:
    """(N, 3) m of points over a road that bends upwards with a radius; downwards if it is negative."""
    angle = distance / radius
    reach = radius - above
    return np.column_stack([reach * np.sin(angle), aside, radius - reach * np.cos(angle)])


def road_pairs(radius: float, seconds: float, seed: int) -> list[ImagePair]:
    """Image pairs of a robot that drives along the road, past posts and points of the road."""
    rng = np.random.default_rng(seed)
    n = 12000
    far = SPEED * seconds + 6.0
    distance = rng.uniform(0.0, far, n)
    floor = rng.random(n) < 0.6
    aside = np.where(floor, rng.uniform(-0.6, 0.6, n), rng.choice([-1.0, 1.0], n) * rng.uniform(0.6, 2.5, n))
    points = on_road(distance, aside, np.where(floor, 0.0, rng.uniform(0.0, 1.5, n)), radius)
    pairs = []
    for k in range(round(seconds / PAIR_S)):
        seen = []
        for t in (k * PAIR_S, (k + 1) * PAIR_S):
            way = SPEED * t
            (centre,) = on_road(np.array([way]), np.zeros(1), np.array([HEIGHT]), radius)
            mount = rotations(np.array([[0.0, -way / radius, 0.0]]))[0] @ ROBOT_FROM_LEVEL
            local = (points - centre) @ mount
            ahead = local[:, 2] > 0.2
            normal = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
            pixels = normal * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
            seen.append((normal, ahead & (local[:, 2] < 6.0) & CAMERA.contains(pixels, 4.0)))
        both = rng.permutation(np.flatnonzero(seen[0][1] & seen[1][1]))[:150]
        noise = 0.1 / CAMERA.fx * rng.normal(size=(2, len(both), 2))
        before, after = seen[0][0][both] + noise[0], seen[1][0][both] + noise[1]
        pairs.append(ImagePair(k * PAIR_S, (k + 1) * PAIR_S, before, after))
    return pairs


@pytest.mark.parametrize("radius", first_quick([75.0, 1e6, -75.0], 2), ids=["dip", "plane", "crest"])
def test_a_road_that_bends_tells_the_scale(radius: float):
    """A street with a vertical curve of 500 m under a camera of 1.65 m, made smaller: 2 m ahead it is 27 mm
    off the plane under the robot, a tenth of the camera's height.
    """
    seconds = 24.0
    stamps = np.arange(0.0, seconds + 0.05, 0.1)
    reported = 1.04 * SPEED * stamps
    estimator = Estimator(DECLARED, sigma_of(CAMERA))
    estimate = estimator.batch(road_pairs(radius, seconds, 1), WheelTrack(stamps, reported, 0.0 * stamps))
    assert estimate.shown[Parameter.WHEEL_SCALE]
    assert estimate.vector[Parameter.WHEEL_SCALE] == pytest.approx(-math.log(1.04), abs=0.01)


def test_heights_are_those_where_the_camera_comes_nearest():
    """Ahead by 1 m, then turned down by 0.1 rad and ahead by another; y is down, z ahead."""
    down = np.array([0.0, 1.0, 0.0])
    level = CameraMotions(np.eye(3), np.array([0.0, 0.0, -1.0]), down)
    # The second image's camera looks up by 0.1 rad, and a point ahead lies lower in it.
    up = rotations(np.array([[-0.1, 0.0, 0.0]]))[0]
    raised = CameraMotions(up, -up @ np.array([0.0, 0.0, 1.0]), down)
    way = [DrivenStep(3, 0.3, raised), DrivenStep(4, 0.6, level)]
    last = np.array([0.0, 0.0, 1.0]) + up.T @ np.array([0.0, 0.0, 1.0])
    there = last + up.T @ np.array([0.2, 0.5, 0.3])
    heights, off = heights_over(
        [np.array([[0.0, 0.4, -0.1], [0.0, 0.45, 0.2]]), there[None]], [way, way], down
    )
    assert heights == pytest.approx([0.4, 0.45, 0.5])
    assert off == pytest.approx([-0.1, 0.2, math.hypot(0.2, 0.3)])


def test_a_way_goes_on_only_without_a_gap():
    motion = CameraMotions(np.eye(3), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    ways: list[list[DrivenStep]] = []
    for k in range(3 * FOLLOWED):
        follow(ways, 0.5 * k, 0.5 * k + (0.4 if k == FOLLOWED else 0.5), motion)
    until_gap = [min(FOLLOWED, FOLLOWED + 1 - k) for k in range(FOLLOWED + 1)]
    assert [len(way) for way in ways[: FOLLOWED + 1]] == until_gap
    assert len(ways[FOLLOWED + 1]) == FOLLOWED
    assert len(ways[-1]) == 1
