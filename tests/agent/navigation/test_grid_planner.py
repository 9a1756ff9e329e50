"""Costs against Dijkstra's search of another library, on random grids."""

import math

import networkx as nx
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from mapweave.agent.navigation.local_planner import GridPlanner

LEAST, WISHED = 0.2, 0.4


def random_room(rng: np.random.Generator) -> np.ndarray:
    """(R, C) m, distance from things strewn over a grid of 5 cm cells."""
    free = rng.random((rng.integers(15, 30), rng.integers(15, 30))) > 0.015
    free[0, 0] = False
    return 0.05 * distance_transform_edt(free)


def searched(room: np.ndarray, first: tuple[int, int]) -> np.ndarray:
    """The same costs by networkx."""
    graph = nx.DiGraph()
    graph.add_node(first)
    rows, columns = room.shape
    for row in range(rows):
        for column in range(columns):
            for dx in (-1, 0, 1):
                for dy in (-1, 0, 1):
                    there = (row + dx, column + dy)
                    if (dx or dy) and 0 <= there[0] < rows and 0 <= there[1] < columns:
                        enough = room[there] >= LEAST
                        leaving = room[row, column] < LEAST and room[there] > room[row, column]
                        if enough or leaving:
                            lack = min(max((WISHED - room[there]) / (WISHED - LEAST), 0.0), 1.0)
                            toll = math.hypot(dx, dy) * (1.0 + 3.0 * lack**2)
                            graph.add_edge((row, column), there, weight=toll)
    costs = np.full(room.shape, np.inf)
    for cell, cost in nx.single_source_dijkstra_path_length(graph, first).items():
        costs[cell] = cost
    return costs


@pytest.mark.parametrize("seed", range(6))
def test_costs_are_the_least(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    first = tuple(int(rng.integers(n)) for n in room.shape)
    np.testing.assert_allclose(
        GridPlanner(room, first, LEAST, WISHED).costs, searched(room, first), atol=1e-9
    )


@pytest.mark.parametrize("seed", range(20))
def test_a_search_that_ends_at_its_goal_finds_the_same_way(seed):
    rng = np.random.default_rng(50 + seed)
    room = random_room(rng)
    first, goal = (tuple(int(rng.integers(n)) for n in room.shape) for _ in range(2))
    whole = GridPlanner(room, first, LEAST, WISHED).way_to(goal)
    assert np.array_equal(GridPlanner(room, first, LEAST, WISHED, goal).way_to(goal), whole)


@pytest.mark.parametrize("seed", range(6))
def test_a_way_leads_there_over_cells_with_room(seed):
    rng = np.random.default_rng(100 + seed)
    room = random_room(rng)
    cells = np.argwhere(room >= LEAST)
    first, goal = (tuple(int(v) for v in cells[rng.integers(len(cells))]) for _ in range(2))
    passage = GridPlanner(room, first, LEAST, WISHED)
    costs, way = passage.costs, passage.way_to(goal)
    assert tuple(way[0]) == first
    assert (np.abs(np.diff(way, axis=0)).max(axis=1) == 1).all(), "neighbour by neighbour"
    assert (room[tuple(way.T)] >= LEAST).all()
    if np.isfinite(costs[goal]):
        assert tuple(way[-1]) == goal
        steps = np.hypot(*np.diff(way, axis=0).T)
        lack = np.clip((WISHED - room[tuple(way[1:].T)]) / (WISHED - LEAST), 0.0, 1.0)
        assert (steps * (1 + 3 * lack**2)).sum() == pytest.approx(costs[goal])
    else:
        reached = np.argwhere(np.isfinite(costs) & (room >= LEAST))
        assert np.hypot(*(way[-1] - goal)) == pytest.approx(np.hypot(*(reached - goal).T).min())


def test_a_way_keeps_to_the_middle_of_a_gap():
    """A wall with a gap of 0.7 m: the way passes it in the middle, though that is longer."""
    room = np.full((41, 41), False)
    room[20, :10] = room[20, 24:] = True
    free = 0.05 * distance_transform_edt(~room)
    way = GridPlanner(free, (5, 5), LEAST, WISHED).way_to((35, 5))
    (crossing,) = way[way[:, 0] == 20][:, 1][:1]
    assert 14 <= crossing <= 19


def test_out_of_where_there_is_too_little_room():
    """From beside a wall the way leads off first; into such a place it does not lead."""
    room = 0.05 * np.tile(np.arange(20.0), (20, 1))
    passage = GridPlanner(room, (10, 1), LEAST, WISHED)
    way = passage.way_to((10, 15))
    assert (np.diff(room[tuple(way[:4].T)]) > 0).all()
    assert tuple(passage.way_to((10, 0))[-1]) == (10, 4)
    assert np.isinf(GridPlanner(room, (10, 15), LEAST, WISHED).costs[:, :4]).all()
