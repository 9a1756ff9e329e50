"""Keyframes: what is left of an episode is made in pieces."""

import numpy as np

from mapweave import Camera, MapId, NodeId, Pose2, PoseGaussian, RobotDescription
from mapweave.agent.mapping import keyframe_builder, loop_closures
from mapweave.agent.mapping.anchored_keyframe import AnchoredKeyframe
from mapweave.agent.mapping.keyframe_builder import KeyframeBuilder
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.edge_limits import unmeasurable
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.registration.selection import SelectionSettings

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)


def node(number: int) -> Node:
    pose = PoseGaussian.from_sigmas(Pose2(0.1 * number, 0.0, 0.0), 0.01, 0.01)
    return Node(NodeId("r0", 1, number), number, pose, CAMERA, Landmarks.empty())


def test_a_piece_compares_a_node_with_one_earlier_place(monkeypatch):
    """A comparison takes as long as following the tracks: four in one tick were a late tick."""
    compared: list[int] = []
    monkeypatch.setattr(loop_closures, "register", lambda earlier, *_: compared.append(earlier.id.number))
    earlier = [NodePut(node(number)) for number in (1, 2, 3)]
    builder = KeyframeBuilder(MapId("r0", 1), RobotDescription(CAMERA), SelectionSettings(), earlier, 4)
    builder.join(AnchoredKeyframe(node(4), np.zeros(0, np.int64)))
    by_piece = []
    for _ in range(4):
        compared.clear()
        builder.continue_pending()
        by_piece.append(tuple(compared))
    assert by_piece == [(3,), (2,), (1,), ()]


def test_no_edge_is_written_that_servers_refuse(monkeypatch, caplog):
    """After a long way without landmarks a robot knows nothing of a drive; servers refuse such edges."""
    sigmas = iter((11.0, 9.0))
    ends = node(1).id, node(2).id

    def driven_edge(*_: object) -> Edge:
        return Edge(
            node(3).id, *ends, PoseGaussian.from_sigmas(Pose2(5.0), next(sigmas), 0.1), EdgeKind.DRIVEN
        )

    monkeypatch.setattr(keyframe_builder, "driven_edge", driven_edge)
    earlier = [NodePut(node(number)) for number in (1, 2)]
    builder = KeyframeBuilder(MapId("r0", 1), RobotDescription(CAMERA), SelectionSettings(), earlier, 4)
    builder.drove(object(), None)  # type: ignore[arg-type]
    assert not builder.map.edges
    assert "left out of the map: edge r0.1.3 has a standard deviation of 11 m" in caplog.text
    builder.drove(object(), None)  # type: ignore[arg-type]
    assert not any(map(unmeasurable, builder.map.edges.values())) and len(builder.map.edges) == 1
