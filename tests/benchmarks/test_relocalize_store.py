"""The store of a large fleet, by what a server reads out of it."""

import networkx as nx
import numpy as np
import pytest

from benchmarks.relocalize.distractors import Differences, Distractors
from benchmarks.relocalize.places import TruePlace
from benchmarks.relocalize_start.store import fill
from mapweave import HybridMap, MapId, Pose2
from mapweave.hybridmap.change import NodePut
from mapweave.mapserver.log.sqlite_store import SqliteStore
from synthetic.world import room, take_map


@pytest.mark.slow
def test_each_robot_has_its_nodes_and_they_hang_together(tmp_path, opened):
    rng = np.random.default_rng(5)
    tour = [Pose2(2.5, 2.0, 0.7 * k) for k in range(6)]
    nodes = take_map(room(0, 0, 5, 4, 400, rng), MapId("m0", 1), tour, rng)[0]
    places = [
        TruePlace(node, pose, 0, rng.integers(0, 256, (len(node.landmarks), 128)).astype(np.uint8))
        for node, pose in zip(nodes, tour, strict=True)
    ]
    none = Differences(np.zeros((1, 32), np.float32), np.zeros((1, 128), np.int16))
    distractors, result = Distractors(places, none, 7), list[int]()
    fill(tmp_path / "store", places, distractors, 20, result.append)
    store = opened(SqliteStore(tmp_path / "store"))
    maps = {map_id: HybridMap(change.body for change in store.replay(map_id)) for map_id in store.maps()}
    assert sum(result) == 20
    assert {map_id: len(outcome.nodes) for map_id, outcome in maps.items()} == {
        MapId("d0", 1): 14,
        MapId("m0", 1): 6,
    }
    for outcome in maps.values():
        assert nx.is_connected(outcome.graph())
        for edge in outcome.edges.values():
            a, b = (outcome.nodes[end].map_from_robot.mean for end in (edge.a, edge.b))
            assert (a @ edge.a_from_b.mean).distance(b) < 1e-5
    puts = (change.body for change in store.replay(MapId("d0", 1)) if isinstance(change.body, NodePut))
    for k, put in enumerate(puts):
        assert np.array_equal(put.node.landmarks.codes, distractors.node(k).landmarks.codes)
