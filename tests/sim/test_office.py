"""Offices of many seeds, measured on a picture of their walls and furniture rather than by their own plan."""

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import SettingsError
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world
from mapweave.sim.worlds.office import DOOR
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

SEEDS = range(9)
SCALE = 40
"""Pixels a metre."""
ROBOT = 0.16 + 0.12
"""Radius of the robot, and what it keeps from walls, m."""


class Drawing:
    """Solid things drawn as polygons; distances by OpenCV's transform."""

    def __init__(self, world: World) -> None:
        """Draw walls and furniture; all outside is solid."""
        x0, y0, x1, y1 = world.plan.bounds
        self._origin = np.array([x0, y0])
        free = np.full((int((y1 - y0) * SCALE) + 2, int((x1 - x0) * SCALE) + 2), 255, np.uint8)
        for box in (*world.plan.walls, *world.plan.furniture):
            cv2.fillPoly(free, [np.round((box.corners - self._origin) * SCALE).astype(np.int32)], 0)
        free[0], free[-1], free[:, 0], free[:, -1] = 0, 0, 0, 0
        self.distances = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) / SCALE

    def at(self, x: float, y: float) -> tuple[int, int]:
        """Row and column."""
        column, row = np.round((np.array([x, y]) - self._origin) * SCALE).astype(int)
        return int(row), int(column)


@pytest.fixture(scope="module")
def offices() -> list[World]:
    """Of three, four and five rooms."""
    return [make_world("office", seed, rooms=3 + seed % 3) for seed in SEEDS]


@pytest.mark.parametrize("seed", SEEDS)
def test_every_room_can_be_reached(offices: list[World], seed: int):
    """One region of floor for a robot with a margin: in all rooms, through all doors, without pockets."""
    world = offices[seed]
    drawing = Drawing(world)
    rooms = [r for r in world.plan.rooms if r.name.startswith("room")]
    doors = [r for r in world.plan.rooms if r.name.startswith("door")]
    assert len(rooms) == len(doors) == 3 + seed % 3
    # Slack of 1.5 pixels: drawn edges are rounded, and the office plans on a grid.
    slack = 1.5 / SCALE
    _, labels = cv2.connectedComponents((drawing.distances > ROBOT - slack).astype(np.uint8))
    main = labels == labels[drawing.at(doors[0].x, doors[0].y)]
    assert main[drawing.distances > ROBOT + slack].all()
    for door in doors:
        assert main[drawing.at(door.x, door.y)]
        assert drawing.distances[drawing.at(door.x, door.y)] > DOOR / 2 - 0.14
    for room in (*rooms, world.plan.room("corridor")):
        low, high = drawing.at(*room.corners[0]), drawing.at(*room.corners[2])
        inside = main[low[0] : high[0], low[1] : high[1]]
        # Walls keep the robot's margin all around; of the rest, furniture leaves at least a third.
        inner = (room.length - 2 * ROBOT) * (room.width - 2 * ROBOT) * SCALE**2
        assert inside.sum() > inner / 3


@pytest.mark.parametrize("seed", SEEDS)
def test_robots_start_free_and_in_their_rooms(offices: list[World], seed: int):
    """Robot i in room i, the fourth where there is place, none near another."""
    world = offices[seed]
    drawing = Drawing(world)
    rooms = sum(r.name.startswith("room") for r in world.plan.rooms)
    poses = world.start_poses(4, seed)
    for robot, pose in enumerate(poses):
        assert world.plan.room_at(pose.x, pose.y) == f"room {robot % rooms}"
        assert drawing.distances[drawing.at(pose.x, pose.y)] > 0.45 - 0.05
        assert all(pose.distance(other) > 0.8 for other in poses[:robot])


@pytest.mark.parametrize("seed", SEEDS)
def test_furniture_is_in_its_room_and_does_not_overlap(offices: list[World], seed: int):
    """Drawn one by one, no piece covers a wall or another piece."""
    plan = offices[seed].plan
    for number, piece in enumerate(plan.furniture):
        for other in (*plan.furniture[:number], *plan.walls):
            boxes = [
                ((b.x, b.y), (b.length - 0.01, b.width - 0.01), np.degrees(b.heading)) for b in (piece, other)
            ]
            assert cv2.rotatedRectangleIntersection(*boxes)[0] == cv2.INTERSECT_NONE


def test_offices_of_different_seeds_differ_and_of_the_same_do_not(offices: list[World]):
    """In their plan and in what hangs on their walls."""
    plans = [world.plan for world in offices]
    assert len({plan.walls for plan in plans}) == len({plan.furniture for plan in plans}) == len(plans)
    again = make_world("office", 3, rooms=3 + 3 % 3)
    assert again.plan == plans[3]
    pictures = [world.panels[5].texture.level(0, 0) for world in (offices[3], again, offices[6])]
    assert np.array_equal(pictures[0], pictures[1])
    assert pictures[0].shape != pictures[2].shape or not np.array_equal(pictures[0], pictures[2])


def test_clearances_are_those_of_the_drawing(offices: list[World]):
    """The plan's formula against OpenCV's distance transform, at random places."""
    rng = np.random.default_rng(0)
    for world in offices[:3]:
        drawing = Drawing(world)
        x0, y0, x1, y1 = world.plan.bounds
        points = rng.uniform([x0, y0], [x1, y1], (300, 2))
        drawn = [drawing.distances[drawing.at(x, y)] for x, y in points]
        np.testing.assert_allclose(world.plan.clearances(points), drawn, atol=2.5 / SCALE)


@pytest.mark.slow
def test_there_is_enough_to_see(offices: list[World]):
    """From free places with random headings a robot finds 60 features, and almost always 15."""
    rng = np.random.default_rng(1)
    counts = []
    for world in offices[1:4]:
        with Simulation(world, ["r0"], 1) as simulation:
            description = simulation.describe("r0")
            sift = Sift(Lens(description.camera, description.distortion))
            for _ in range(6):
                simulation.kidnap("r0", world.plan.random_free_pose(rng, ROBOT))
                counts.append(len(sift.extract(simulation.observe("r0").image)))
    assert np.median(counts) >= 60
    assert np.quantile(counts, 0.1) >= 15


@pytest.mark.parametrize("rooms", [0, 33])
def test_offices_that_cannot_be_built_are_refused(rooms: int):
    with pytest.raises(SettingsError, match=f"rooms must be a whole number, 1 to 32; it is {rooms}"):
        make_world("office", 1, rooms=rooms)
