"""Where a route begins for a robot that stands between nodes."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave.hybridmap.change import Change, EdgePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.reachability import LEAST, Reachability
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.mapserver.routes import Router
from mapweave.merge.explanation.map_explanation import explain_maps
from mapweave.merge.explanation.node_explanation import explain_nodes
from synthetic.maps import changes_of, merger_of
from synthetic.world import Sensing, room, take_map

ME = MapId("a", 1)
STEP = 0.8
SHARP = Sensing(most=150, clutter=5, unknown_depth=0.0, reach=9.0)


@pytest.fixture(scope="module")
def row() -> tuple[Router, list[NodeId]]:
    """Five nodes in a row, which all look the way that they were driven."""
    rng = np.random.default_rng(0)
    tour = [Pose2(1.0 + STEP * k, 2.0) for k in range(5)]
    nodes, edges = take_map(room(0, 0, 6, 4, 900, rng), ME, tour, rng, sigma_xy=0.003, sigma_heading=0.003)
    return Router(merger_of({ME: changes_of(nodes, edges)}).merged()), [node.id for node in nodes]


def begin(row: tuple[Router, list[NodeId]], x: float, y: float, goal: int, **arguments: object) -> int:
    """Number of the node at which the way begins for a robot that stands there and knows itself by node 1."""
    router, nodes = row
    here = Pose2(x, y, 1.0)
    answer = router.route(nodes[1], nodes[goal], start_from_robot=here, **arguments)  # type: ignore[arg-type]
    return nodes.index(answer.legs[0].node.id)


@pytest.mark.parametrize("x", [0.25, 0.4, 0.7])
def test_a_robot_on_an_edge_goes_on_and_not_back_to_its_beginning(row: tuple[Router, list[NodeId]], x: float):
    assert begin(row, x, 0.1, goal=4) == 2
    assert begin(row, x, 0.1, goal=0) in (0, 1), "and the other way round"


def test_away_from_the_edge_or_with_it_blocked_nothing_is_cheaper(row: tuple[Router, list[NodeId]]):
    nodes = row[1]
    assert begin(row, 0.1, 0.4, goal=4) == 1
    assert begin(row, 0.2, 0.0, goal=4, blocked=[(nodes[2], nodes[1])]) != 2


def test_the_first_leg_leads_from_the_node_that_the_robot_knows(row: tuple[Router, list[NodeId]]):
    router, nodes = row
    first = router.route(nodes[1], nodes[4], start_from_robot=Pose2(0.5, 0.0, 0.0)).legs[0]
    assert first.node.id == nodes[2]
    relative = first.previous_from_node.mean
    assert math.hypot(relative.x - STEP, relative.y) < 0.03


class OutOfSight(ReachabilityCache):
    """As if something stood between any two nodes that no robot has driven between."""

    def reach(self, edge: Edge, a: Node, b: Node, faded: Sequence[NDArray[np.bool_] | None]) -> Reachability:
        found = super().reach(edge, a, b, faded)
        return replace(found, in_view=min(found.in_view, LEAST - 1))


def test_a_link_that_the_servo_could_not_drive_ties_maps_and_leads_nowhere():
    """Two robots see one wall from three metres apart; then a robot drives from one to the other."""
    rng = np.random.default_rng(1)
    world, other = room(0, 0, 9, 4, 1400, rng), MapId("b", 1)
    logs, ends = {}, []
    for map_id, x in ((ME, 1.6), (other, 4.6)):
        nodes, edges = take_map(world, map_id, [Pose2(x + 0.2 * k, 2.0) for k in range(2)], rng, SHARP)
        logs[map_id] = changes_of(nodes, edges)
        ends.append([node.id for node in nodes])
    merger = merger_of(logs)
    merged = merger.merged()
    assert len(merged.components) == 1 and merged.links, "the poses are tied"
    answer = Router(merged, reaches=OutOfSight()).route(ends[0][0], ends[1][1])
    assert not answer.legs and "only ties poses" in answer.reason
    tried = Router(merged).route(ends[0][0], ends[1][1])
    assert [leg.node.id for leg in tried.legs][:: len(tried.legs) - 1] == [ends[0][0], ends[1][1]]
    (pair,) = [pair for pair in pairwise(leg.node.id for leg in tried.legs) if pair[0].map != pair[1].map]
    assert f"no robot has driven between {pair[0]} and {pair[1]}" in tried.reason, "without another way"
    explanation = explain_nodes(merged, *merged.links[0].pair)
    assert any("ties poses, not driven" in claim and "2.5 m" in claim for claim in explanation.claims)
    joined = explain_maps(merged, ME, other)
    assert joined.joined and "none can be driven" in joined.reason
    between = merged.relative(ends[0][1], ends[1][0])
    assert between is not None
    driven = Edge(NodeId(*ME, 99), ends[0][1], ends[1][0], between, EdgeKind.DRIVEN)
    merger.on_change(Change(ME, 99, 0, EdgePut(driven)))
    router = Router(merger.merged())
    legs = router.route(ends[0][0], ends[1][1]).legs
    assert [leg.node.id for leg in legs] == [*ends[0], *ends[1]]
    blocked = router.route(ends[0][0], ends[1][1], [(ends[0][1], ends[1][0])])
    assert not blocked.legs and "blocked" in blocked.reason, "a block goes away, and opens no other link"
