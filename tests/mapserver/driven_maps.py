"""Maps of nodes at given places with exact edges between them, and how a merger takes them in."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.merger import Merger
from synthetic.maps import changes_of, numbered
from tests.agent.scripted_fleet import bare

EXACT = np.diag([1e-4, 1e-4, 1e-4])


def place_node(node_id: NodeId, place: tuple[float, float]) -> Node:
    return replace(bare(node_id), map_from_robot=PoseGaussian(Pose2(*place), np.diag([1e-6, 1e-6, 1e-6])))


def driven_map(
    map_id: MapId,
    nodes: Sequence[Node],
    joints: Iterable[tuple[int, int]],
    kind: EdgeKind = EdgeKind.DRIVEN,
    covariance: np.ndarray = EXACT,
) -> list[ChangeBody]:
    """The nodes, and an edge between each two that are joined, by their places in the sequence."""
    edges = []
    for number, (a, b) in enumerate(joints, start=1):
        relative = nodes[a].map_from_robot.mean.inverse() @ nodes[b].map_from_robot.mean
        pose = PoseGaussian(relative, covariance)
        edges.append(Edge(EdgeId(*map_id, number), nodes[a].id, nodes[b].id, pose, kind))
    return changes_of(nodes, edges)


def take_in(merger: Merger, map_id: MapId, bodies: Iterable[ChangeBody], first: int = 1) -> None:
    """Change by change, as a server does."""
    for change in numbered(map_id, bodies, first):
        merger.on_change(change)
