"""Where a route begins for a robot that stands between nodes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.synthetic import room, take_map
from hybridmap.change import Change, EdgePut, NodePut
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2
from mapserver.merger import Merger
from mapserver.routes import Router

ME = MapId("a", 1)
STEP = 0.8


@pytest.fixture(scope="module")
def row() -> tuple[Router, list[NodeId]]:
    """Five nodes in a row, which all look the way that they were driven."""
    rng = np.random.default_rng(0)
    tour = [Pose2(1.0 + STEP * k, 2.0) for k in range(5)]
    nodes, edges = take_map(room(0, 0, 6, 4, 900, rng), ME, tour, rng, sigma_xy=0.003, sigma_heading=0.003)
    merger = Merger()
    for number, body in enumerate([*map(NodePut, nodes), *map(EdgePut, edges)], start=1):
        merger.on_change(Change(ME, number, 0, body))
    return Router(merger.merged()), [node.id for node in nodes]


def begin(row: tuple[Router, list[NodeId]], x: float, y: float, goal: int, **arguments: object) -> int:
    """Number of the node at which the way begins for a robot that stands there and knows itself by node 1."""
    router, nodes = row
    here = Pose2(x, y, 1.0)
    answer = router.route(nodes[1], nodes[goal], start_from_robot=here, **arguments)  # type: ignore[arg-type]
    return nodes.index(answer.legs[0].node.id)


@pytest.mark.parametrize("x", [0.25, 0.4, 0.7])
def test_a_robot_on_an_edge_goes_on_and_not_back_to_its_beginning(
    row: tuple[Router, list[NodeId]], x: float
) -> None:
    assert begin(row, x, 0.1, goal=4) == 2
    assert begin(row, x, 0.1, goal=0) in (0, 1), "and the other way round"


def test_beside_the_edge_or_if_it_is_blocked_nothing_is_cheaper(row: tuple[Router, list[NodeId]]) -> None:
    nodes = row[1]
    assert begin(row, 0.1, 0.4, goal=4) == 1
    assert begin(row, 0.2, 0.0, goal=4, blocked=[(nodes[2], nodes[1])]) != 2


def test_the_first_leg_leads_from_the_node_that_the_robot_knows(row: tuple[Router, list[NodeId]]) -> None:
    router, nodes = row
    first = router.route(nodes[1], nodes[4], start_from_robot=Pose2(0.5, 0.0, 0.0)).legs[0]
    assert first.node.id == nodes[2]
    relative = first.previous_from_node.mean
    assert math.hypot(relative.x - STEP, relative.y) < 0.03
