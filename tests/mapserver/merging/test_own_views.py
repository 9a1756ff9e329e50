"""A map whose views contradict its own way is named and makes no answer ambiguous; an honest one is not."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.active_nodes import doubted
from mapweave.mapserver.merging.merge_surroundings import MergeSurroundings
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.merging.node_comparisons import NodeComparisons
from mapweave.mapserver.merging.own_views_search import OwnViewsSearch
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.server import MapServer
from mapweave.merge.outlier_rejection.decision_cache import DecisionCache
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ConsistencySettings
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.world import room, take_map
from synthetic.wrong_geometry import ODD, SCENES, FaultyFleet, OdometryFault, draw_fleet
from tests.quick import first_quick

Lie = Callable[[Node, int], Node]


def honest(node: Node, place: int) -> Node:
    return node


def too_deep(node: Node, place: int) -> Node:
    """Depths that are 30 % too long, and said to be as well known as before."""
    marks = node.landmarks
    depths, sigmas = (column * np.float32(1.3) for column in (marks.depths, marks.depth_sigmas))
    return replace(node, landmarks=replace(marks, depths=depths, depth_sigmas=sigmas))


def other_lens(node: Node, place: int) -> Node:
    """Focal lengths that are too short and too long in turns."""
    by = (0.7, 1.5)[place % 2]
    return replace(node, camera=replace(node.camera, fx=by * node.camera.fx, fy=by * node.camera.fy))


def merged(fleet: FaultyFleet, lie: Lie = honest, left_out: frozenset[MapId] = frozenset()) -> MergedMap:
    """The fleet's maps by a server, with the fourth robot's nodes as a lie has them."""
    nodes, edges = fleet.maps[ODD]
    false = [lie(node, place) for place, node in enumerate(nodes)]
    merger = Merger()
    for change in replace(fleet, maps={**fleet.maps, ODD: (false, edges)}).changes(left_out):
        merger.on_change(change)
    return merger.merged()


@cache
def without_odd(seed: int) -> set[tuple[NodeId, NodeId]]:
    """The pairs that are linked where the fourth robot's map never came."""
    fleet = draw_fleet(seed, SCENES["room"], OdometryFault.NONE, stops=2)
    return {link.pair for link in merged(fleet, left_out=frozenset({ODD})).links}


@pytest.mark.parametrize("seed", first_quick([33001, 33002], 1, 1))
@pytest.mark.parametrize("lie", first_quick([too_deep, other_lens], 1))
def test_a_map_whose_views_contradict_its_own_way_is_named(lie: Lie, seed: int):
    fleet = draw_fleet(seed, SCENES["room"], OdometryFault.NONE, stops=2)
    found = merged(fleet, lie)
    assert found.implausible.keys() == {ODD}
    assert "pairs of its views do not fit its own way" in found.implausible[ODD]
    # Its nodes answer where no others do, and the others have the links that they had without it.
    assert {node.map for node in doubted(found)} == {ODD}
    assert {link.pair for link in found.links if ODD not in link.maps} == without_odd(seed)


@pytest.mark.parametrize("seed", first_quick([33001, 33002], 0, 1))
@pytest.mark.parametrize("fault", [OdometryFault.SLIP, OdometryFault.CARRIED, OdometryFault.NONE])
def test_views_do_not_contradict_a_way_that_slipped_once(fault: OdometryFault, seed: int):
    """Wrong geometry has rules of its own: one slip is no share by which all is too long."""
    assert not merged(draw_fleet(seed, SCENES["room"], fault, stops=2)).implausible


def test_a_robot_that_never_returns_is_judged_by_its_neighbours():
    """The merge compares no nodes that an edge joins: it would learn nothing about other maps."""
    rng = np.random.default_rng(5)
    map_id, tour = MapId("r0", 1), [Pose2(0.7 + 0.5 * k, 2.0, 0.05 * k) for k in range(8)]
    nodes, edges = take_map(room(0, 0, 9, 4, 900, rng), map_id, tour, rng, sigma_xy=0.01, sigma_heading=0.005)
    assert not _by_neighbours(map_id, nodes, edges)
    deep = [too_deep(node, place) for place, node in enumerate(nodes)]
    assert "times as long" in _by_neighbours(map_id, deep, edges)
    lenses = [other_lens(node, place) for place, node in enumerate(nodes)]
    assert "agree on no pose" in _by_neighbours(map_id, lenses, edges)
    # Between photographs nothing has measured how long anything is: each pair has a scale of its own.
    vague = [_of_unknown_scale(node) for node in deep]
    assert not _by_neighbours(map_id, vague, edges)


def _of_unknown_scale(node: Node) -> Node:
    sigmas = np.float32(0.25) * node.landmarks.depths
    return replace(node, landmarks=replace(node.landmarks, depth_sigmas=sigmas))


def _by_neighbours(map_id: MapId, nodes: list[Node], edges: list[Edge]) -> str:
    one = HybridMap()
    for node in nodes:
        one.apply(NodePut(node))
    for edge in edges:
        one.apply(EdgePut(edge))
    # Edges that lead nowhere are of no map, and later drives tell nothing of what was seen.
    away = NodeId(*map_id, 999)
    one.apply(
        EdgePut(
            Edge(NodeId(*map_id, 998), nodes[0].id, away, PoseGaussian(Pose2(), np.eye(3)), EdgeKind.MAPPED)
        )
    )
    comparisons = NodeComparisons(PlaceDatabase(), one.nodes.get, MergerCounters())
    pieces = DecisionCache().fragments({map_id: one}, ConsistencySettings())
    return OwnViewsSearch(comparisons).reason(map_id, one, pieces, ())


LYING, TRUE = 48, 24
"""Nodes of a robot that chooses its ids: those whose depths are wrong, and others."""


def test_a_robot_that_chooses_its_ids_does_not_choose_what_is_looked_at():
    """It knows the code, and numbers its nodes so that by an unkeyed choice its true nodes are looked at."""
    one = _with_chosen_ids()
    assert not _reason(one, b""), "else the ids are not chosen well enough to show anything"
    for key in (b"a", b"b", b"c"):
        assert "times as long" in _reason(one, key)


def test_each_store_has_a_choice_of_its_own_which_servers_keep(tmp_path):
    keys = list[bytes]()
    live, repeatable = MergeSurroundings.live, MergeSurroundings.repeatable
    for name, surroundings in (("a", live), ("a", live), ("b", live), ("c", repeatable)):
        bus, path = MemoryBus(MemoryHub()), tmp_path / f"{name}.sqlite"
        with MapServer(bus, Keys("demo"), path, "s0", surroundings=surroundings) as server:
            keys.append(server._worker._merger._own_views._key)
    first, again, other, simulated = keys
    assert first == again != other
    assert simulated == b"", "a simulation is repeatable"


def _with_chosen_ids() -> HybridMap:
    """A drive around a room, of which the depths are too long behind the first third."""
    rng = np.random.default_rng(7)
    tour = [Pose2(2.0 + 0.25 * (k % 18), 0.8 + 1.2 * (k // 18), 0.03 * (k % 18)) for k in range(TRUE + LYING)]
    drawn, search = MapId("r0", 1), OwnViewsSearch(_comparisons(HybridMap()))
    nodes, edges = take_map(room(0, 0, 9, 7, 1800, rng), drawn, tour, rng, sigma_xy=0.01, sigma_heading=0.005)
    ids: dict[NodeId, NodeId] = {}
    numbers = iter(range(1000, 10**9))
    for place, node in enumerate(nodes):
        # Of each pair of a node that lies, what the choice orders by is to be high.
        near = [other.id for other in nodes[:place] if _apart(other, node) < 3.0 and place >= TRUE]
        ids[node.id] = next(
            chosen
            for chosen in (NodeId(*drawn, number) for number in numbers)
            if all(search._drawn(f"{ids[other]} {chosen}")[0] >= 40 for other in near)
        )
    one = HybridMap()
    for place, node in enumerate(nodes):
        said = too_deep(node, place) if place >= TRUE else node
        one.apply(NodePut(replace(said, id=ids[node.id])))
    for edge in edges:
        number = NodeId(*drawn, 1 + edge.id.number)
        one.apply(EdgePut(replace(edge, id=number, a=ids[edge.a], b=ids[edge.b])))
    return one


def _apart(a: Node, b: Node) -> float:
    between = a.map_from_robot.mean.inverse() @ b.map_from_robot.mean
    return float(np.hypot(between.x, between.y))


def _comparisons(one: HybridMap) -> NodeComparisons:
    return NodeComparisons(PlaceDatabase(), one.nodes.get, MergerCounters())


def _reason(one: HybridMap, key: bytes) -> str:
    (map_id,) = {node.map for node in one.nodes}
    pieces = DecisionCache().fragments({map_id: one}, ConsistencySettings())
    return OwnViewsSearch(_comparisons(one), key).reason(map_id, one, pieces, ())
