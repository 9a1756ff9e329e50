"""A robot that hides wrong depths among nodes that show next to nothing, as many as it likes."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.merging.node_comparisons import NodeComparisons
from mapweave.mapserver.merging.own_views_search import LEAST_LANDMARKS, OwnViewsSearch
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.merge.outlier_rejection.decision_cache import DecisionCache
from mapweave.merge.settings import ConsistencySettings
from synthetic.world import room, take_map
from tests.quick import first_quick

DRIVE, DECOYS, EDGES = 24, 100, 13
"""Nodes of a drive that never returns, those beside them, and edges of each of these."""


@pytest.mark.parametrize(
    ("seed", "landmarks"), first_quick(product([5, 6, 7, 11, 12, 13], [LEAST_LANDMARKS - 1, 1]), 1)
)
def test_nodes_with_few_landmarks_hide_no_wrong_depths(seed: int, landmarks: int):
    """With two of three keys of a store the map was not named any more."""
    for key in (b"", b"a", b"b"):
        assert "times as long" in _reason(_diluted(seed, landmarks, too_deep=1.3), key)
        assert not _reason(_diluted(seed, landmarks, too_deep=1.0), key)


def test_a_map_of_such_nodes_alone_is_not_judged():
    assert not _reason(_diluted(5, 1, too_deep=1.3, drive=1), b"")


def _diluted(seed: int, landmarks: int, too_deep: float, drive: int = LEAST_LANDMARKS) -> HybridMap:
    """A drive past a wall, its nodes with at least `drive` landmarks, and decoys with `landmarks` each."""
    rng, tour = np.random.default_rng(seed), [Pose2(0.7 + 0.5 * k, 2.0, 0.05 * k) for k in range(DRIVE)]
    world, map_id = room(0, 0, 18, 4, 1800, rng), MapId("r0", 1)
    nodes, edges = take_map(world, map_id, tour, rng, sigma_xy=0.01, sigma_heading=0.005)
    one, numbers = HybridMap(), iter(range(10_001, 10**6, 2))
    if drive < LEAST_LANDMARKS:
        nodes = [_some(node, drive) for node in nodes]
    for node in nodes:
        one.apply(NodePut(_deeper(node, too_deep)))
    for edge in edges:
        one.apply(EdgePut(edge))
    decoys = list[Node]()
    for k in range(DECOYS):
        decoy = replace(_some(nodes[k % DRIVE], landmarks), id=NodeId("r0", 1, next(numbers)))
        one.apply(NodePut(decoy))
        for other in [nodes[k % DRIVE], *decoys[max(0, k - EDGES + 1) :]]:
            between = other.map_from_robot.mean.inverse() @ decoy.map_from_robot.mean
            pose, number = PoseGaussian(between, edges[0].a_from_b.covariance), NodeId("r0", 1, next(numbers))
            one.apply(EdgePut(replace(edges[0], id=number, a=other.id, b=decoy.id, a_from_b=pose)))
        decoys.append(decoy)
    return one


def _some(node: Node, count: int) -> Node:
    return replace(node, landmarks=node.landmarks.take(np.arange(count)))


def _deeper(node: Node, by: float) -> Node:
    marks, factor = node.landmarks, np.float32(by)
    return replace(
        node, landmarks=replace(marks, depths=factor * marks.depths, depth_sigmas=factor * marks.depth_sigmas)
    )


def _reason(one: HybridMap, key: bytes) -> str:
    map_id = MapId("r0", 1)
    pieces = DecisionCache().fragments({map_id: one}, ConsistencySettings())
    comparisons = NodeComparisons(PlaceDatabase(), one.nodes.get, MergerCounters())
    return OwnViewsSearch(comparisons, key).reason(map_id, one, pieces, ())
