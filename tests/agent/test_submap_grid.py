"""A grid of submaps against a grid that was drawn with the true poses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave import MapId, Node, NodeId, Pose2
from mapweave.agent.occupancy_grid import DECIDED, OccupancyGrid
from mapweave.agent.submap_grid import MOST_SUBMAPS, STRETCH, SubmapGrid
from synthetic.world import room, take_map
from tests.agent.test_occupancy_grid import ROBOT, SETTINGS, measure

# A corridor 2 m wide around a block: (x0, y0, x1, y1) m.
AROUND = np.array([
    [-4.2, -4.2, 4.2, -4], [-4.2, 4, 4.2, 4.2], [-4.2, -4, -4, 4], [4, -4, 4.2, 4], [-2, -2, 2, 2],
])  # fmt: skip
CORNERS = [(3, -3), (3, 3), (-3, 3), (-3, -3), (0, -3)]
"""m, of a way around from (0, -3)."""
DRIFT = math.radians(0.05)
"""rad for each 5 cm: 24 degrees around."""
RNG = np.random.default_rng(0)
WIDE = replace(SETTINGS, side=24.0)
PROTOTYPE: Node = take_map(room(0, 0, 5, 4, 50, RNG), MapId("r0", 1), [Pose2(1.0, 1.0)], RNG)[0][0]


def drive() -> tuple[list[Pose2], list[Pose2]]:
    """True poses all the way around, 5 cm apart, and what a robot whose heading drifts takes for them."""
    true, taken = [Pose2(0.0, -3.0, 0.0)], [Pose2()]
    for corner in CORNERS:
        here = np.array([true[-1].x, true[-1].y])
        way = np.array(corner) - here
        turn = math.atan2(way[1], way[0]) - true[-1].heading
        moves = [Pose2(0.0, 0.0, math.remainder(turn, math.tau))] if abs(turn) > 1e-9 else []
        moves += [Pose2(0.05)] * round(float(np.hypot(*way)) / 0.05)
        for move in moves:
            true.append(true[-1] @ move)
            taken.append(taken[-1] @ move @ Pose2(0.0, 0.0, DRIFT if move.x else 0.0))
    return true, taken


def drifting_node(number: int, pose: Pose2) -> Node:
    mean = replace(PROTOTYPE.map_from_robot, mean=pose)
    return replace(PROTOTYPE, id=NodeId("r0", 1, number), map_from_robot=mean)


def drawn() -> tuple[SubmapGrid, OccupancyGrid, OccupancyGrid, dict[NodeId, Pose2]]:
    """By a drifting robot; by the same without submaps; with true poses; and where the nodes truly lie.

    All of it as seen from where the robot is at the end.
    """
    true, taken = drive()
    floor, plain, exact = SubmapGrid(ROBOT, WIDE), *(OccupancyGrid(ROBOT, WIDE) for _ in range(2))
    end_from_world = taken[-1] @ true[-1].inverse()
    nodes = {}
    for k, (pose, wrong) in enumerate(zip(true, taken, strict=True)):
        if k % 10 == 0:
            floor.see_node(drifting_node(k, wrong))
            nodes[NodeId("r0", 1, k)] = end_from_world @ pose
        seen = measure(pose, AROUND)
        floor.see(wrong, seen)
        plain.see(wrong, seen)
        exact.see(end_from_world @ pose, seen)
    return floor, plain, exact, nodes


def agreement(floor: OccupancyGrid, exact: OccupancyGrid) -> float:
    """Share of the cells known in either of two grids that both call the same."""
    a, b = floor.taken().odds, exact.taken().odds
    known = (np.abs(a) > DECIDED) | (np.abs(b) > DECIDED)
    same = (np.sign(a) == np.sign(b)) & (np.abs(a) > DECIDED) & (np.abs(b) > DECIDED)
    return float(same[known].mean())


def test_it_is_an_occupancy_grid_until_a_loop_closes():
    floor, plain, exact, nodes = drawn()
    assert (floor.taken().odds == plain.taken().odds).all()
    assert agreement(floor, exact) < 0.75, "the drift is one that matters"
    assert floor.correct(nodes)
    assert agreement(floor, exact) > 0.88
    assert not floor.correct(nodes), "it lies there already"


def test_what_moves_by_less_than_a_cell_stays_as_it_was_drawn():
    floor, plain, _, _ = drawn()
    taken = drive()[1]
    as_taken = {NodeId("r0", 1, k): taken[k] @ Pose2(0.04, 0.02, 0.005) for k in range(0, len(taken), 10)}
    assert not floor.correct(as_taken)
    assert (floor.taken().odds == plain.taken().odds).all()


def test_what_belongs_to_a_node_that_is_gone_stays():
    floor, plain, _, _ = drawn()
    assert not floor.correct({})
    assert (floor.taken().odds == plain.taken().odds).all()


def test_what_a_robot_sees_that_was_found_again_stays_where_it_was_found():
    """It is carried back to its first node, whose own pose it takes up: seen from there, the rest moves."""
    floor, *_ = drawn()
    true, taken = drive()
    floor.go_on_from(drifting_node(0, taken[0]))
    exact = OccupancyGrid(ROBOT, WIDE)
    start_from_world = taken[0] @ true[0].inverse()
    for k in range(90):
        seen = measure(true[k], AROUND)
        floor.see(start_from_world @ true[k], seen)
        exact.see(start_from_world @ true[k], seen)
    by_first = {NodeId("r0", 1, k): start_from_world @ true[k] for k in range(0, len(true), 10)}
    assert floor.correct(by_first)
    known = np.abs(exact.taken().odds) > 1.0
    same = np.sign(floor.taken().odds) == np.sign(exact.taken().odds)
    assert same[known].mean() > 0.97
    newest = floor._submaps[-1]
    assert newest.node == NodeId("r0", 1, 0)
    assert newest.moved.distance(Pose2()) < 1e-9


@pytest.mark.slow
def test_a_long_way_takes_a_bounded_number_of_submaps():
    floor = SubmapGrid(ROBOT, WIDE)
    seen = np.full(len(ROBOT.ranger_bearings), 0.5)
    for k in range(MOST_SUBMAPS + 50):
        floor.see_node(drifting_node(k, Pose2(k * 1.1 * STRETCH)))
        floor.see(Pose2(k * 1.1 * STRETCH), seen)
    assert len(floor._submaps) == MOST_SUBMAPS
