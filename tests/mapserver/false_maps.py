"""Maps that no honest robot makes: of copies, and of true views with wrong ways between them."""

from dataclasses import replace

import numpy as np

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.wire.codec import decode_change
from synthetic.world import take_map
from tests.mapserver.test_set_apart import TOUR, WORLD, sound_logs

FIRST, LAST = MapId("a", 1), MapId("z", 1)
"""Maps are sorted by name: one that lies is before or behind the others."""
STEP = np.diag([0.03, 0.03, 0.02]) ** 2


def copies(map_id: MapId) -> list[ChangeBody]:
    """Two nodes of one robot and two of the other, with wrong ways between them."""
    logs = [[decode_change(message).body for message in log] for log in sound_logs().values()]
    nodes = [body.node for log in logs for body in log[:2] if isinstance(body, NodePut)]
    assert len(nodes) == 4
    return chain(map_id, nodes, Pose2(1.0, 2.0, 0.5), STEP)


def views(map_id: MapId, step: Pose2, covariance: np.ndarray) -> list[ChangeBody]:
    """Own views of the room, with wrong ways between them."""
    return chain(map_id, take_map(WORLD, map_id, TOUR, np.random.default_rng(8))[0], step, covariance)


def chain(map_id: MapId, nodes: list[Node], step: Pose2, covariance: np.ndarray) -> list[ChangeBody]:
    return driven(map_id, nodes, [step] * (len(nodes) - 1), covariance)


def driven(
    map_id: MapId, nodes: list[Node], steps: list[Pose2], covariance: np.ndarray = STEP
) -> list[ChangeBody]:
    """Nodes with these ways between them."""
    out: list[ChangeBody] = []
    for k, node in enumerate(nodes):
        out.append(NodePut(replace(node, id=NodeId(*map_id, 2 * k + 1), stamp_ns=k * 10**9)))
        if k:
            ends = NodeId(*map_id, 2 * k - 1), NodeId(*map_id, 2 * k + 1)
            edge = Edge(
                NodeId(*map_id, 2 * k), *ends, PoseGaussian(steps[k - 1], covariance), EdgeKind.MAPPED
            )
            out.append(EdgePut(edge))
    return out
