"""Hand-held photographs: recognised, answered as a place and not as a pose, also on the wire."""

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.merge.islands import Islands
from mapweave.merge.pose_graph.verdicts import Verdicts
from mapweave.wire.messages import decode, encode
from synthetic.world import Sensing, World, room, take_node, take_view
from tests.hand_held import photograph

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
AT, NEXT = Pose2(2.0, 2.5, 0.1), Pose2(0.4, 0.0, 0.0)
SHARP = Sensing(pixel_sigma=0.5, depth_share=0.02, unknown_depth=0.0)


def places(seed: int) -> tuple[World, list[Node]]:
    rng = np.random.default_rng(seed)
    world = room(0.0, 0.0, 6.0, 5.0, 900, rng)
    poses = [AT, AT @ NEXT]
    return world, [
        take_node(world, NodeId("p0", 1, k + 1), at, PoseGaussian(at, HERE.covariance), rng, SHARP)
        for k, at in enumerate(poses)
    ]


def answered(nodes: list[Node], view: View) -> RelocalizeAnswer:
    hybrid_map = HybridMap(map(NodePut, nodes))
    way = PoseGaussian(NEXT, HERE.covariance)
    hybrid_map.apply(EdgePut(Edge(NodeId("p0", 1, 9), nodes[0].id, nodes[1].id, way, EdgeKind.MAPPED)))
    index, maps = PlaceIndex(), {MapId("p0", 1): hybrid_map}
    index.extend(nodes)
    merged = Islands().merge(maps, Verdicts(), set(maps), ManualConstraints())
    return Relocalizer(index, {node.id: node for node in nodes}.get, merged).answer(view)


@pytest.mark.parametrize("seed", range(4))
def test_a_photograph_is_a_place_of_unknown_distance(seed: int):
    world, nodes = places(seed)
    off = Pose2(-0.4, 0.1, 0.05)
    view, _ = take_view(world, AT @ off, np.random.default_rng(seed + 100), SHARP)
    answer = answered([photograph(node, scale=1.2, pitch=0.015) for node in nodes], view)
    assert answer.certainty is Certainty.PLACE
    best = answer.candidates[0]
    assert not best.distance_known
    there = Pose2() if best.node.number == 1 else NEXT
    assert best.node_from_robot.mahalanobis2(there.inverse() @ off) < 16.3
    again = decode(encode(answer), RelocalizeAnswer)
    assert again.certainty is Certainty.PLACE
    assert not again.candidates[0].distance_known
    measured = answered(nodes, view)
    assert measured.certainty is Certainty.FOUND
    assert measured.candidates[0].distance_known


@pytest.mark.parametrize("seed", range(4))
def test_elsewhere_is_no_place(seed: int):
    world, nodes = places(seed)
    held = [photograph(node, scale=0.9, roll=0.02) for node in nodes]
    for heading in (1.7, 3.1, -1.6):
        view, _ = take_view(world, Pose2(2.0, 2.5, heading), np.random.default_rng(seed))
        assert answered(held, view).certainty is Certainty.UNKNOWN
        stranger, _ = take_view(places(seed + 50)[0], AT, np.random.default_rng(seed))
        assert answered(held, stranger).certainty is Certainty.UNKNOWN
