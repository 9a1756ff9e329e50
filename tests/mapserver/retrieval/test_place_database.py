"""The place database: announced nodes are found, superseded nodes of earlier drives are left out."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.retrieval.place_database import SECOND, SETTLED, PlaceDatabase
from synthetic.world import room, take_node, take_view

WORLD = room(0, 0, 5, 4, 600, np.random.default_rng(1))
AT = Pose2(2.2, 2.0, 0.2)
VIEW = take_view(WORLD, AT, np.random.default_rng(4))[0]
BASE = take_node(
    WORLD, NodeId("a", 1, 1), AT, PoseGaussian.from_sigmas(AT, 0.02, 0.01), np.random.default_rng(2)
)


def filled(*nodes: Node) -> PlaceDatabase:
    places = PlaceDatabase()
    for node in nodes:
        places.observe(node)
    places.put(nodes)
    return places


def test_an_announced_node_is_found_at_once():
    places = PlaceDatabase()
    places.announce(BASE)
    assert BASE.id in places and [node for node, _ in places.query(VIEW)] == [BASE.id]
    assert not places.query(VIEW, exclude=[BASE.id])


@pytest.mark.parametrize(
    ("epoch", "later_s", "left_out"),
    [(1, 60.0, False), (1, SETTLED + 1.0, True), (2, 60.0, True)],
    ids=["today", "an hour later", "another epoch"],
)
def test_superseded_nodes_of_earlier_drives_are_left_out(epoch: int, later_s: float, left_out: bool):
    newer = replace(BASE, id=NodeId("a", epoch, 2), stamp_ns=BASE.stamp_ns + int(later_s * SECOND))
    nodes = {node.id: node for node in (BASE, newer)}
    places = filled(*nodes.values())
    assert places.leave_out([BASE.id], nodes.get) == {}
    assert (BASE.id not in places) == left_out and newer.id in places
    # A node that was compared with it before is compared with it still; others are not.
    assert (BASE.id in places.overlaps(newer, nodes.get)) != left_out
    assert BASE.id in places.overlaps(newer, nodes.get, [(BASE.id, newer.id)])
    revived = places.leave_out([], nodes.get)
    assert BASE.id in places and revived.keys() == ({BASE.id} if left_out else set())
    for overlaps in revived.values():
        assert overlaps == places.overlaps(BASE, nodes.get) and newer.id in overlaps


def test_a_node_that_comes_again_is_found_again_and_a_removed_one_is_not():
    newer = replace(BASE, id=NodeId("a", 2, 1))
    nodes = {node.id: node for node in (BASE, newer)}
    places = filled(*nodes.values())
    places.leave_out([BASE.id], nodes.get)
    places.observe(BASE)
    places.put([BASE])
    assert BASE.id in places and not places.leave_out([], nodes.get)
    places.remove(BASE, BASE.id)
    assert BASE.id not in places and len(places) == 1
