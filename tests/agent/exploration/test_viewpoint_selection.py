"""Room to move and places that are known, against counting by hand and brute force."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave import Camera, HybridMap, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian, RobotDescription
from mapweave.agent.clearance import ASIDE, BEFORE, clearance
from mapweave.agent.exploration.fleet_coverage import FleetCoverage
from mapweave.agent.exploration.viewpoint_selection import next_viewpoint, seen_around, views_of
from mapweave.agent.mission import ServerAnswer, WhatIsKnown
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.settings import ExplorerSettings, OccupancyGridSettings
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.query import KnownAnswer
from tests.agent.test_occupancy_grid import unknown

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
BODY = RobotDescription(CAMERA, ranger_bearings=BEARINGS, ranger_reach=3.0)

readings = st.lists(st.floats(0.0, 3.0), min_size=16, max_size=16).map(np.array)
directions = st.sampled_from(BEARINGS)


@settings(max_examples=80, deadline=None)
@given(readings, directions)
@example(np.array([3.0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1]), -math.pi)  # nothing in reach
def test_the_footprint_moves_freely_within_the_clearance(proximity, direction):
    """Moved step by step it comes no nearer to what the rangers hit than room promises.

    Beyond the reach of the rangers nothing is promised: the room there is asked for as 0.
    """
    angles = np.array(BEARINGS)
    hits = (proximity + BODY.radius)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ahead = np.array([math.cos(direction), math.sin(direction)])
    before = hits[(hits @ ahead) > 0.3 * np.linalg.norm(hits, axis=1)]
    for way in np.arange(0.0, clearance(BODY, proximity, direction, 0.0), 0.01):
        gone = before - way * ahead
        along, aside = gone @ ahead, np.abs(gone @ [-ahead[1], ahead[0]])
        in_way = aside < BODY.radius + ASIDE - 1e-9
        assert (along[in_way] >= BODY.radius + BEFORE - 1e-6).all()


@settings(max_examples=100, deadline=None)
@given(readings, directions, st.integers(0, 15), st.floats(0.0, 1.0))
def test_approaching_obstacles_reduce_the_clearance(proximity, direction, which, share):
    nearer = proximity.copy()
    nearer[which] *= share
    assert clearance(BODY, nearer, direction) <= clearance(BODY, proximity, direction) + 1e-9


def test_without_rangers_clearance_is_unknown():
    assert clearance(BODY, np.zeros(0), 0.0) == math.inf
    assert clearance(BODY, np.zeros(0), 0.0, 0.6) == 0.6
    one = RobotDescription(CAMERA, ranger_bearings=(math.pi,), ranger_reach=3.0)
    assert clearance(one, np.array([2.0]), 0.0, 0.6) == 0.6
    assert clearance(one, np.array([2.0]), math.pi) == pytest.approx(2.0 - BEFORE)


def a_map(*poses: Pose2) -> HybridMap:
    return HybridMap(
        NodePut(
            Node(NodeId("r0", 1, k + 1), 0, PoseGaussian.from_sigmas(p, 0.1, 0.1), CAMERA, Landmarks.empty())
        )
        for k, p in enumerate(poses)
    )


def test_a_place_is_covered_by_its_nodes_fields_of_view():
    here = np.array([1.0, 2.0])
    share = 2 * CAMERA.semi_aperture / math.tau
    assert seen_around(views_of(HybridMap()), here, 0.7) == 0.0
    hybrid_map = a_map(Pose2(1.2, 2.0, 0.3))
    assert seen_around(views_of(hybrid_map), here, 0.7) == pytest.approx(share, abs=1 / 36)
    assert seen_around(views_of(hybrid_map), here, 0.1) == 0.0
    assert seen_around(
        views_of(a_map(Pose2(1.2, 2.0, 0.3), Pose2(0.9, 2.0, 0.3))), here, 0.7
    ) == pytest.approx(share, abs=1 / 36), "twice the same way is no more"
    around = [Pose2(1.0, 2.1, heading) for heading in np.arange(0, math.tau, 0.9)]
    assert seen_around(views_of(a_map(*around)), here, 0.7) == 1.0


# What others have looked around at

MAP = MapId("r0", 1)
NO_VIEWS = np.zeros((0, 2))


def looks(x: float, y: float, headings: np.ndarray) -> np.ndarray:
    """(N, 4) views from one place."""
    return np.array([[x, y, heading, CAMERA.semi_aperture] for heading in headings])


ALL_AROUND = np.remainder(np.arange(0.0, math.tau, 0.9) + math.pi, math.tau) - math.pi


def test_any_robots_views_cover_a_place():
    coverage = FleetCoverage(MAP, 8.7)
    assert coverage.question(np.array([1.0, 2.0])) == WhatIsKnown(-1, MAP, 1.0, 2.0, 8.7)
    theirs = np.concatenate([looks(3.0, 0.0, ALL_AROUND), looks(6.0, 0.0, ALL_AROUND[:4])])
    coverage.take(ServerAnswer(-1, KnownAnswer(theirs, "")))
    places = coverage.places(coverage.views, 0.7, 0.75)
    assert np.unique(places, axis=0).tolist() == [[3.0, 0.0]]
    mine = looks(6.1, 0.0, ALL_AROUND[4:])
    both = coverage.places(np.concatenate([coverage.views, mine]), 0.7, 0.75)
    assert np.unique(both, axis=0).tolist() == [[3.0, 0.0], [6.0, 0.0]]


def test_a_server_that_does_not_answer_takes_nothing_back():
    coverage = FleetCoverage(MAP, 8.7)
    assert coverage.places(looks(0.0, 0.0, ALL_AROUND), 0.7, 0.75).shape == (0, 2)
    coverage.take(ServerAnswer(-1, KnownAnswer(looks(3.0, 0.0, ALL_AROUND), "")))
    coverage.take(ServerAnswer(-1, None, "no map server answered"))
    assert len(coverage.views) == len(ALL_AROUND)


def corridor() -> OccupancyGrid:
    """A robot in the middle of a long corridor, 2.4 m wide, that it has swept from where it is."""
    floor = OccupancyGrid(BODY)
    for heading in np.linspace(0.0, math.tau, 90):
        angles = heading + np.array(BEARINGS)
        with np.errstate(divide="ignore"):
            free = np.minimum(1.2 / np.abs(np.sin(angles)) - BODY.radius, 3.0)
        floor.see(Pose2(0.0, 0.0, float(heading)), free)
    return floor


def test_the_next_viewpoint_is_at_an_unvisited_place():
    floor, here = corridor(), np.zeros(2)
    been = here[None]

    def end(others: np.ndarray) -> np.ndarray:
        return next_viewpoint(floor, here, been, been, others, ExplorerSettings())[-1]

    assert abs(end(NO_VIEWS)[0]) > 1.7, "one of the two ends of what it has seen"
    left = np.array([[-2.5, 0.0]])
    assert end(left)[0] > 1.7
    assert end(-left)[0] < -1.7
    # Where others are everywhere, the way on leads past them.
    assert abs(end(np.concatenate([left, -left]))[0]) > 1.7
    everywhere = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-1, 2)), axis=-1).reshape(-1, 2) * 1.0
    assert next_viewpoint(floor, here, everywhere, everywhere, NO_VIEWS, ExplorerSettings()) == []


def test_floor_behind_walls_attracts_no_exploration():
    """Along a corridor everything behind its walls is unknown for ever; a wide unknown end is worth more."""
    floor = corridor()
    middle, end = floor.unknown_in_sight(np.array([[0.0, 0.0], [2.5, 0.0]]), NO_VIEWS, 1.6, 3.0)
    assert middle < 0.5
    assert end > 3.0
    result = floor.unknown_in_sight(np.array([[2.5, 0.0]]), np.array([[4.0, 0.0]]), 1.6, 3.0)
    assert result[0] < end


def in_line(floor: OccupancyGrid, here: np.ndarray, reach: float) -> np.ndarray:
    """Cells within reach that nothing hides, each looked at along a line of its own in steps of 1 cm."""
    occupied = floor.room() == 0.0
    result = np.zeros_like(occupied)
    low, high = floor.cells(here - reach), floor.cells(here + reach)
    for row in range(low[0], high[0] + 1):
        for column in range(low[1], high[1] + 1):
            cell = floor.centre((row, column))
            away = math.dist(cell, here)
            if away <= reach:
                at = floor.cells(here + np.arange(0.0, 1.0, 0.01 / max(away, 0.01))[:, None] * (cell - here))
                result[row, column] = not occupied[at[:, 0], at[:, 1]].any()
    return result


@pytest.mark.parametrize("others", [NO_VIEWS, np.array([[3.6, 0.0]])], ids=["alone", "with others"])
def test_visible_floor_agrees_with_a_test_of_each_cell(others):
    """What others know counts as known."""
    floor, here, reach = corridor(), np.array([2.05, 0.35]), 2.5
    wanted = unknown(floor)
    for other in others:
        wanted &= (
            np.linalg.norm(floor.centres(np.moveaxis(np.indices(wanted.shape), 0, -1)) - other, axis=2) > 1.0
        )
    area = 0.01 * (wanted & in_line(floor, here, reach)).sum()
    (result,) = floor.unknown_in_sight(here[None], others, 1.0, reach)
    assert area > 1.0
    assert result == pytest.approx(area, rel=0.1)


def test_floor_that_was_seen_from_afar_only_agrees_with_a_test_of_each_cell():
    floor, here, reach = corridor(), np.array([1.6, 0.2]), 1.4
    nodes = np.array([[0.0, 0.0], [-0.3, 0.4], [0.4, -0.8]])
    free = ~unknown(floor) & (floor.room() > 0.0)
    near = np.any([in_line(floor, node, reach) for node in nodes], axis=0)
    area = 0.01 * (free & ~near & in_line(floor, here, reach)).sum()
    (result,) = floor.distant_in_sight(here[None], nodes, reach)
    assert area > 1.0
    assert result == pytest.approx(area, rel=0.1)
    assert floor.distant_in_sight(here[None], np.concatenate([nodes, here[None]]), reach)[0] < 0.05


def wall_with_gap(angle: float, gap: float) -> OccupancyGrid:
    """A wall one cell thick, 1 m from the origin, with a gap in its middle; what is before it is known."""
    floor = OccupancyGrid(BODY, OccupancyGridSettings(side=12.0))
    cells = np.argwhere(np.isfinite(floor.taken().odds))
    points = floor.centres(cells)
    ahead = points @ (math.cos(angle), math.sin(angle))
    floor._odds[tuple(cells[ahead < 1.0].T)] = -1.0
    for along in np.arange(-5.0, 5.0, 0.02):
        if abs(along) > gap / 2:
            cell = floor.cells(Pose2(0.0, 0.0, angle).apply(np.array([1.0, along])))
            floor._odds[tuple(cell)] = 1.0
    return floor


@given(st.floats(-math.pi, math.pi))
@settings(max_examples=25, deadline=None)
def test_nothing_is_in_sight_behind_a_wall_or_a_gap_too_narrow_for_the_robot(angle):
    """Before, rays got through a wall between cells that meet at a corner, and through one free cell."""
    behind = [
        wall_with_gap(angle, gap).unknown_in_sight(np.zeros((1, 2)), NO_VIEWS, 1.6, 3.0)[0]
        for gap in (0.0, 0.3, 1.2)
    ]
    assert behind[0] == behind[1] == 0.0
    assert behind[2] > 1.0, "a door is one"


def hall(length: float) -> OccupancyGrid:
    """A hall 2 m wide along x, all of it known, with walls."""
    floor = OccupancyGrid(BODY)
    low, high = floor.cells(np.array([-0.9, -0.9])), floor.cells(np.array([length, 0.9]))
    floor._odds[low[0] - 1 : high[0] + 2, low[1] - 1 : high[1] + 2] = 1.0
    floor._odds[low[0] : high[0] + 1, low[1] : high[1] + 1] = -1.0
    return floor


def test_a_far_place_comes_last_and_is_not_left_out():
    """Before, exploration was complete where nothing was left within 7 m."""
    floor, here = hall(14.0), np.zeros(2)
    places = np.array([[x, 0.0] for x in np.arange(0.0, 12.0, 1.5)])

    def way(been: np.ndarray) -> list[np.ndarray]:
        return next_viewpoint(floor, here, been, been, NO_VIEWS, ExplorerSettings())

    assert way(places)[-1][0] > 12.0, "the end of the hall"
    assert 1.7 <= way(np.delete(places, [2, 3], axis=0))[-1][0] < 7.0, "nearer ones come first"
    assert way(np.array([[x, 0.0] for x in np.arange(0.0, 15.0, 1.5)])) == []
