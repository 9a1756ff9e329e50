"""The floor against geometry of its own, and its ways against another search."""

import math

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from mapweave import Camera, Pose2, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.settings import OccupancyGridSettings
from tests.quick import first_quick

BEARINGS = tuple(np.linspace(-math.pi, math.pi, 36, endpoint=False).tolist())
ROBOT = RobotDescription(
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3), ranger_bearings=BEARINGS, ranger_reach=3.0
)
SETTINGS = OccupancyGridSettings(side=12.0)
CELL = SETTINGS.cell
ENOUGH = ROBOT.radius + SETTINGS.clearance
SLACK = 0.8 * CELL
"""m; a point and the middle of its cell are up to 0.71 cells apart; distances on a grid are a little off."""

# A room with a table, and a wall with a door of 1 m: (x0, y0, x1, y1) m.
SOLIDS = np.array([
    [-4, -3, -3.8, 3], [3.8, -3, 4, 3], [-4, -3, 4, -2.8], [-4, 2.8, 4, 3],
    [1.0, -3, 1.2, 0.2], [1.0, 1.2, 1.2, 3], [-2.4, -1.0, -1.6, 0.4],
])  # fmt: skip


def measure(pose: Pose2, solids: np.ndarray = SOLIDS) -> np.ndarray:
    """(K,) m, what exact rangers measure: each ray against each box by slabs."""
    angles = pose.heading + np.array(BEARINGS)
    way = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    low, high = solids[None, :, :2], solids[None, :, 2:]
    here = np.array([pose.x, pose.y])
    a, b = (low - here) / way, (high - here) / way
    enter, leave = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
    reached = np.where((enter <= leave) & (enter > 0), enter, np.inf).min(axis=1)
    return np.clip(reached - ROBOT.radius, 0.0, ROBOT.ranger_reach)


def known_room(rng: np.random.Generator | None = None) -> OccupancyGrid:
    """A floor after a drive through the room."""
    rng = rng or np.random.default_rng(0)
    floor = OccupancyGrid(ROBOT, SETTINGS)
    for x, y in [(-3, -2), (-3, 1.5), (-1, 1.5), (-1, -2), (0.2, 0.7), (1.8, 0.7), (2.6, -1.5), (2.6, 1.8)]:
        for _ in range(12):
            pose = Pose2(x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1), rng.uniform(-3, 3))
            floor.see(pose, measure(pose))
    return floor


def occupied(floor: OccupancyGrid) -> np.ndarray:
    """Cells that hold something, and by SciPy the exact distance of all others from them, m."""
    return floor.room() == 0.0


def unknown(floor: OccupancyGrid) -> np.ndarray:
    """Cells of which nothing is known."""
    taken = floor.taken()
    return np.asarray(np.abs(taken.odds) <= taken.decided)


def exact_room(floor: OccupancyGrid) -> np.ndarray:
    return distance_transform_edt(~occupied(floor)) * CELL


def around(floor: OccupancyGrid, points: np.ndarray) -> np.ndarray:
    """(N,) m, exact distance from points to the nearest middle of an occupied cell."""
    things = np.array([floor.centre(tuple(c)) for c in np.argwhere(occupied(floor))])
    return np.asarray(cKDTree(things).query(points)[0])


def dense(start: np.ndarray, corners: list[np.ndarray]) -> np.ndarray:
    """(N, 2) m, points every centimetre along a way."""
    pieces = []
    for a, b in zip([start, *corners[:-1]], corners, strict=True):
        pieces.append(a + np.linspace(0, 1, int(np.linalg.norm(b - a) / 0.01) + 2)[:, None] * (b - a))
    return np.concatenate(pieces)


# Looking


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1)),
    st.lists(st.floats(0.15, 3.0), min_size=36, max_size=36),
)
def test_rays_are_free_along_them_and_occupied_at_their_end(where, readings):
    pose, proximity = Pose2(*where), np.array(readings)
    floor = OccupancyGrid(ROBOT, SETTINGS)
    floor.see(pose, proximity)
    full, known = occupied(floor), ~unknown(floor)
    angles = pose.heading + np.array(BEARINGS)
    way = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    here = np.array([pose.x, pose.y])
    fine = np.arange(0, 3.3, 0.005)
    touched, crossed = np.zeros(full.shape, bool), np.zeros(full.shape, bool)
    ends = set()
    for direction, reading in zip(way, proximity, strict=True):
        reach = reading + ROBOT.radius
        along = here + fine[fine < reach + 0.005, None] * direction
        # Also corners that a ray cuts between two of these points, 5 mm apart.
        for nudge in ([0, 0], [0.003, 0.003], [0.003, -0.003], [-0.003, 0.003], [-0.003, -0.003]):
            touched[tuple(floor.cells(along + nudge).T)] = True
        before = here + fine[fine < min(reach - 0.5 * CELL, ROBOT.ranger_reach), None] * direction
        cells, count = np.unique(floor.cells(before), axis=0, return_counts=True)
        crossed[tuple(cells[count * 0.005 > 1.1 * CELL].T)] = True
        if reading < ROBOT.ranger_reach - 0.05:
            ends.add(tuple(floor.cells(here + reach * direction)))
    assert {tuple(cell) for cell in np.argwhere(full)} <= ends
    assert crossed.any()
    assert known[crossed].all(), "a ray that goes right through a cell tells of it"
    own = np.linalg.norm(np.array([floor.centre(cell) for cell in ends]).reshape(-1, 2) - here, axis=1)
    for cell, distance in zip(ends, own, strict=True):
        assert full[cell] or distance < 0.3, "what is seen is entered, but where the robot stands is nothing"
    # Nothing is known but along a ray, and below the robot.
    middles = (np.indices(full.shape) + 0.5) * CELL - SETTINGS.side / 2
    far = np.hypot(*(middles - here[:, None, None])) > 0.3
    assert not (known & far & ~touched).any()


def test_a_reading_at_its_maximum_is_no_wall():
    floor = OccupancyGrid(ROBOT, SETTINGS)
    floor.see(Pose2(), np.full(36, ROBOT.ranger_reach))
    assert not occupied(floor).any()
    assert floor.drivable()[tuple(floor.cells(np.array([1.0, 0.0])))]


def test_readings_that_do_not_fit_the_robot_are_left_out():
    floor = OccupancyGrid(ROBOT, SETTINGS)
    floor.see(Pose2(), np.zeros(0))
    floor.see(Pose2(), np.full(5, 0.3))
    assert unknown(floor).all()


def test_the_room_is_seen_as_it_is():
    floor = known_room()
    middles = np.array([floor.centre(tuple(c)) for c in np.argwhere(occupied(floor))])
    outside = np.maximum(
        np.maximum(SOLIDS[None, :, :2] - middles[:, None], middles[:, None] - SOLIDS[None, :, 2:]), 0
    )
    assert np.linalg.norm(outside, axis=2).min(axis=1).max() < 0.75 * CELL, "only real things are entered"
    assert len(middles) > 150
    assert np.abs(floor.room() - exact_room(floor)).max() < 0.05 * floor.room().max()


def test_moved_obstacles_are_forgotten_and_new_ones_are_seen():
    floor, pose = known_room(), Pose2(-1.0, -2.0, 0.0)
    box = np.array([[0.1, -2.2, 0.4, -1.8]])
    place = tuple(floor.cells(np.array([0.13, -2.0])))
    assert not occupied(floor)[place]
    came = 0
    while not occupied(floor)[place]:
        floor.see(pose, measure(pose, np.concatenate([SOLIDS, box])))
        came += 1
    assert came <= 5
    for _ in range(100):
        floor.see(pose, measure(pose, np.concatenate([SOLIDS, box])))
    gone = 0
    while occupied(floor)[place]:
        floor.see(pose, measure(pose))
        gone += 1
    assert gone <= 12, "however long it stood there"


def test_cells_and_their_middles_belong_together():
    floor = OccupancyGrid(ROBOT, SETTINGS)
    cells = np.random.default_rng(0).integers(0, 120, (200, 2))
    middles = np.array([floor.centre(tuple(cell)) for cell in cells])
    assert np.array_equal(floor.cells(middles), cells)
    assert np.array_equal(floor.cells(middles + 0.049), cells)
    assert np.array_equal(floor.cells(np.array([[-99.0, 99.0]])), [[0, 119]])


# Ways


@pytest.mark.parametrize("seed", range(3))
def test_ways_are_as_long_as_dijkstras(seed):
    rng = np.random.default_rng(seed)
    floor = known_room(rng)
    drivable = floor.drivable()
    graph = nx.Graph()
    for cell in map(tuple, np.argwhere(drivable)):
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            there = (cell[0] + dx, cell[1] + dy)
            if drivable[there]:
                graph.add_edge(cell, there, weight=CELL * math.hypot(dx, dy))
    start = np.array([-3.0, 1.5])
    reach = 5.0
    ways = floor.ways(start, reach)
    route = {tuple(cell): length for cell, length in zip(ways.cells.tolist(), ways.lengths, strict=True)}
    expected = nx.single_source_dijkstra_path_length(graph, tuple(floor.cells(start).tolist()))
    near = {cell for cell, length in expected.items() if length <= reach}
    assert len(near) > 500
    assert near <= set(route) <= set(expected)
    for cell, length in route.items():
        assert length == pytest.approx(expected[cell], abs=1e-6)


@pytest.mark.parametrize("seed", first_quick(range(3), 1))
def test_ways_keep_clear_of_everything(seed):
    rng = np.random.default_rng(seed)
    floor = known_room(rng)
    start = floor.centre(tuple(floor.cells(np.array([-3.0, 1.5]))))
    ways = floor.ways(start, 30.0)
    assert ways.positions[:, 0].max() > 2.5, "through the door"
    for index in rng.integers(0, len(ways.cells), 25):
        corners = ways.path(ways.cells[index])
        if not corners:
            assert np.allclose(ways.positions[index], start)
            continue
        assert np.allclose(corners[-1], ways.positions[index])
        line = dense(start, corners)
        assert around(floor, line).min() > ENOUGH - SLACK
        assert not occupied(floor)[tuple(floor.cells(line).T)].any()
        # Straight pieces cut the corners of the grid's way; they never make it longer.
        length = sum(np.linalg.norm(b - a) for a, b in zip([start, *corners[:-1]], corners, strict=True))
        assert np.linalg.norm(corners[-1] - start) - 1e-9 <= length <= ways.lengths[index] + 1e-9


def test_a_wall_without_a_door_is_the_end():
    solids = np.concatenate([SOLIDS, [[1.0, -3, 1.2, 3]]])
    floor = OccupancyGrid(ROBOT, SETTINGS)
    for x, y in [(-3, -2), (-1, 1.5), (0.2, 0.7), (1.9, 0.7), (2.6, -1.5), (2.6, 1.8)]:
        for k in range(15):
            pose = Pose2(x, y, 0.1 * k)
            floor.see(pose, measure(pose, solids))
    ways = floor.ways(np.array([0.2, 0.7]), 30.0)
    assert len(ways.cells) > 100
    assert ways.positions[:, 0].max() < 1.0 - ENOUGH + SLACK


def test_a_robot_that_is_too_near_only_leaves():
    floor = known_room()
    room = floor.room()
    # 14 cm from the table, nearer than it would go by itself.
    start = np.array([-1.46, -0.3])
    first = tuple(floor.cells(start))
    assert 0 < room[first] < ENOUGH
    ways = floor.ways(start, 10.0)
    assert len(ways.cells) > 300
    drivable = floor.drivable()
    for index in np.random.default_rng(0).integers(0, len(ways.cells), 40):
        chain = [first] + [tuple(floor.cells(c)) for c in ways.path(ways.cells[index])]
        gaps = [room[cell] for cell in chain]
        out = next(k for k, cell in enumerate(chain) if drivable[cell])
        assert (np.diff(gaps[: out + 1]) > -1e-6).all(), "it comes no nearer while it leaves"
        assert all(drivable[cell] for cell in chain[out:]), "and once away it stays away"


def test_no_way_out_of_a_trap_leads_through_a_wall():
    """Where everything around is nearer still, there is no way."""
    box = np.array(
        [[-0.3, -0.3, 0.3, -0.22], [-0.3, 0.22, 0.3, 0.3], [-0.3, -0.3, -0.22, 0.3], [0.22, -0.3, 0.3, 0.3]]
    )
    floor = OccupancyGrid(ROBOT, SETTINGS)
    for k in range(20):
        pose = Pose2(0, 0, 0.05 * k)
        floor.see(pose, measure(pose, box))
    assert len(floor.ways(np.zeros(2), 10.0).cells) == 0


def test_a_shifted_grid_keeps_its_overlap():
    """Against a grid that is never shifted, cell by cell, where both reach."""
    rng = np.random.default_rng(4)
    whole, small = OccupancyGrid(ROBOT, SETTINGS), OccupancyGrid(ROBOT, OccupancyGridSettings(side=7.0))
    at = np.zeros(2)
    for _ in range(60):
        at = np.clip(at + rng.uniform(-0.2, 0.2, 2), [-3.0, -2.4], [0.0, 2.4])
        pose = Pose2(*at, rng.uniform(-3, 3))
        small.roll(at)
        ranges = measure(pose)
        whole.see(pose, ranges)
        small.see(pose, ranges)
    near = at + rng.uniform(-0.5, 0.5, (200, 2))
    assert np.array_equal(*(f.drivable(unknown=True)[tuple(f.cells(near).T)] for f in (whole, small)))
    for point in near[:20]:
        (cell,) = small.cells(point[None])
        assert np.abs(small.centre(tuple(cell)) - point).max() <= CELL / 2 + 1e-9
    small.roll(at + 50.0)
    assert (small.room() > 3.0).all(), "far away it knows nothing any more"
