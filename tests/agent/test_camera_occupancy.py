"""The camera's occupancy grid against geometry of its own: nothing solid is ever free."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from mapweave import Camera, Landmarks, Node, NodeId, Pose2, PoseGaussian, RobotDescription
from mapweave.agent.camera_occupancy import (
    BEARINGS,
    DARED,
    GAP,
    REACH,
    SLACK,
    CameraOccupancyGrid,
    free_sectors,
)
from mapweave.agent.settings import OccupancyGridSettings

HEIGHT = 0.3
ROBOT = RobotDescription(Camera(320, 240, 277.0, 277.0, 159.5, 119.5, HEIGHT, 0.05))
SETTINGS = OccupancyGridSettings(side=12.0)
AHEAD = math.radians(28)

WALLS = [[-2.6, -2.6, -2.4, 2.6], [2.4, -2.6, 2.6, 2.6], [-2.6, -2.6, 2.6, -2.4], [-2.6, 2.4, 2.6, 2.6]]
BOX = [-0.2, 0.9, 0.4, 1.5]
"""x0, y0, x1, y1 m."""
Boxes = Sequence[list[float]]
PLACES = [(x, y) for x in (-0.4, 0.1, 0.6) for y in (-1.5, -0.5)]


def hits(eye: np.ndarray, angles: np.ndarray, solids: Boxes) -> np.ndarray:
    """(K, S) m, where rays meet boxes, by slabs; infinite where they do not."""
    way = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    boxes = np.array(solids)
    a, b = (boxes[None, :, :2] - eye) / way, (boxes[None, :, 2:] - eye) / way
    enter, leave = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def view(
    pose: Pose2, rng: np.random.Generator, textured: Boxes, blank: Boxes = (), low: float = 0.05,
    high: float = 0.28,
) -> Node:  # fmt: skip
    """A node that sees landmarks on what is textured, at exact depths; what is blank hides them."""
    camera = ROBOT.camera
    eye = pose.apply(np.array([[camera.mount_forward, 0.0]]))[0]
    bearings = rng.uniform(-AHEAD, AHEAD, 60)
    ranges = hits(eye, pose.heading + bearings, [*textured, *blank])
    nearest, which = ranges.min(axis=1), ranges.argmin(axis=1)
    seen = np.isfinite(nearest) & (which < len(textured))
    bearings, nearest = bearings[seen], nearest[seen]
    depths, aside = nearest * np.cos(bearings), nearest * np.sin(bearings)
    heights = rng.uniform(low, high, len(depths))
    pixels = np.stack(
        [camera.cx - camera.fx * aside / depths, camera.cy - camera.fy * (heights - HEIGHT) / depths], axis=1
    )
    landmarks = Landmarks(
        pixels.astype(np.float32), np.zeros((len(depths), 32), np.uint8),
        depths.astype(np.float32), (0.01 * depths).astype(np.float32),
    )  # fmt: skip
    return Node(NodeId("r0", 1, 1), 1, PoseGaussian(pose, np.zeros((3, 3))), camera, landmarks)


def looked_around(
    rng: np.random.Generator, places: Sequence[tuple[float, float]] = PLACES, **other: Any
) -> CameraOccupancyGrid:
    """The grid after views all around some places, which were driven to and a little forth from."""
    floor = CameraOccupancyGrid(ROBOT, SETTINGS)
    for x, y in places:
        for heading in np.arange(0.0, math.tau, 0.7):
            pose = Pose2(x, y, heading)
            floor.drive(pose)
            floor.see_node(view(pose, rng, **other))
    return floor


def free(floor: CameraOccupancyGrid, points: np.ndarray) -> np.ndarray:
    cells = floor.cells(points)
    return np.asarray(floor._free[cells[:, 0], cells[:, 1]])


def points_in(box: list[float], inset: float) -> np.ndarray:
    x, y = np.arange(box[0] + inset, box[2] - inset, 0.05), np.arange(box[1] + inset, box[3] - inset, 0.05)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("seed", range(4))
def test_floor_is_free_and_what_is_textured_is_not(seed: int):
    floor = looked_around(np.random.default_rng(seed), textured=[*WALLS, BOX])
    inner = points_in([-2.2, -2.2, 2.2, 0.5], 0.0)
    assert free(floor, inner).mean() > 0.9
    # Deeper in it than a cell's diagonal.
    assert not free(floor, points_in(BOX, 0.15)).any()
    behind = points_in([-0.2, 1.6, 0.4, 2.3], 0.0)
    core = [[BOX[0] + 0.1, BOX[1] + 0.1, BOX[2] - 0.1, BOX[3] - 0.1]]
    shown = np.zeros(len(behind), np.bool_)
    for x, y in PLACES:
        offsets = behind - [x, y]
        ways = hits(np.array([x, y]), np.arctan2(offsets[:, 1], offsets[:, 0]), core)[:, 0]
        shown |= ways > np.hypot(*offsets.T)
    assert (~shown).sum() > 10
    assert not free(floor, behind[~shown]).any(), "what the box hides stays unknown"
    cells = np.argwhere(floor.drivable())
    centres = np.array([floor.centre((int(a), int(b))) for a, b in cells])
    gaps = np.maximum(np.abs(centres - [0.1, 1.2]) - 0.3, 0.0)
    assert np.hypot(*gaps.T).min() > ROBOT.radius
    assert np.abs(centres).max() < 2.4 - ROBOT.radius


@pytest.mark.parametrize("seed", range(4))
def test_what_is_blank_is_not_free_if_it_is_wider_than_the_gap(seed: int):
    floor = looked_around(np.random.default_rng(seed), textured=WALLS, blank=[BOX])
    assert min(BOX[2] - BOX[0], BOX[3] - BOX[1]) > GAP
    assert not free(floor, points_in(BOX, 0.15)).any()


def test_structure_above_the_camera_shows_no_floor():
    floor = looked_around(np.random.default_rng(0), [(0.0, 0.0)], textured=WALLS, low=0.35, high=0.9)
    assert not free(floor, points_in([0.5, -2.0, 2.0, 2.0], 0.0)).any()
    cells = floor.cells(np.array([[2.4, y] for y in np.arange(-1.0, 1.0, 0.1)]))
    assert floor._occupied[cells[:, 0], cells[:, 1]].any(), "low enough to be touched it is in the way"


def test_sectors_end_before_the_nearest_landmark_and_where_neighbours_are_apart():
    bearings, ranges = np.radians([-20.0, -18.0, -16.0, 0.0]), np.array([2.0, 1.0, 2.0, 2.0])
    edges, ends = free_sectors(bearings, ranges, np.full(4, 0.2), HEIGHT, 0.1)
    assert len(edges) == 4
    assert ends == pytest.approx([0.9, 0.9, GAP / (edges[3] - edges[2])], abs=1e-9)
    assert free_sectors(bearings[:1], ranges[:1], np.full(1, 0.2), HEIGHT, 0.1)[1].size == 0


def test_the_footprint_is_free_and_a_touch_is_not_argued_away():
    floor = CameraOccupancyGrid(ROBOT, SETTINGS)
    for x in np.arange(0.0, 1.0, 0.05):
        floor.drive(Pose2(x))
    here = Pose2(0.95)
    assert floor.drivable()[tuple(floor.cells(np.array([0.5, 0.0])))]
    assert not floor.drivable()[tuple(floor.cells(np.array([0.5, 0.25])))]
    ahead, behind = (floor.readings(here)[BEARINGS.index(way)] for way in (0.0, math.pi))
    assert ahead == pytest.approx(DARED, abs=0.15)
    assert behind == pytest.approx(0.95 + SLACK, abs=0.15)
    assert floor.known_ahead(Pose2(0.0), 0.0, REACH) == pytest.approx(0.95, abs=0.15)
    floor.touch(here, 0.0)
    beyond = np.array([[0.95 + ROBOT.radius + 0.1, 0.0]])
    for seed in range(12):
        floor.see_node(view(Pose2(0.0), np.random.default_rng(seed), WALLS))
    assert not free(floor, beyond)[0]
    assert floor.readings(here)[BEARINGS.index(0.0)] < 0.1
    floor.drive(Pose2(1.2))
    assert free(floor, beyond)[0], "now it was driven over"


def test_the_share_of_the_border_behind_which_nothing_is_known():
    everywhere = [(x, y) for x in (-1.6, 0.0, 1.6) for y in (-1.6, 0.0, 1.6)]
    rng = np.random.default_rng(1)
    closed = looked_around(rng, everywhere, textured=WALLS)
    half = looked_around(rng, everywhere[:3], textured=WALLS[2:])
    start = np.array([-1.6, -1.6])
    assert closed.open_border(start, 9.0) < 0.1
    assert half.open_border(start, 9.0) > 0.3
    assert CameraOccupancyGrid(ROBOT, SETTINGS).open_border(start, 9.0) == 0.0
