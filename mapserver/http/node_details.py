"""One node of the merged map, for people: where it is, what it saw, what it costs, what replaces it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind, Node
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.superseded import Superseded
from mapweave.merge.floors import floor_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.codec import encode_body


@dataclass(frozen=True, slots=True)
class Neighbour:
    """What an edge leads to.

    Attributes:
        node: the other end.
        kind: of the edge.
        shared: landmarks that both ends show.
    """

    node: NodeId
    kind: EdgeKind
    shared: int


@dataclass(frozen=True, eq=False)
class NodeDetails:
    """A node.

    Attributes:
        node: the node itself: id, image size and the pixels of its landmarks.
        map: that it belongs to.
        floor: on which it is; empty if that is not known.
        stamp_ns: when its image was taken.
        map_from_robot: pose in its own map.
        merged_from_robot: pose in the merged map; None if its map is not part of it.
        component: number of the component; None likewise.
        landmarks: how many.
        with_depth: landmarks whose depth is known.
        faded: indices of the landmarks that have faded.
        bytes: of its change on the wire.
        superseded: what replaces it; None if nothing does.
        neighbours: where edges and links lead.
    """

    node: Node
    map: MapId
    floor: str
    stamp_ns: int
    map_from_robot: PoseGaussian
    merged_from_robot: PoseGaussian | None
    component: int | None
    landmarks: int
    with_depth: int
    faded: tuple[int, ...]
    bytes: int
    superseded: Superseded | None
    neighbours: tuple[Neighbour, ...]


def node_details(merged: MergedMap, node_id: NodeId, floors: Mapping[MapId, str]) -> NodeDetails:
    """Everything about a node.

    Args:
        merged: the map.
        node_id: the node.
        floors: labels of maps.

    Raises:
        InvalidValue: there is none.
    """
    merged.check(node_id)
    own = merged.maps[node_id.map]
    node, placement = own.nodes[node_id], merged.poses.get(node_id)
    refused = {refusal.edge for refusal in merged.refused}
    edges = [edge for edge in own.edges.values() if edge.id not in refused]
    edges += [link.edge() for link in merged.links if node_id in link.pair]
    neighbours = [
        Neighbour(edge.b if edge.a == node_id else edge.a, edge.kind, len(edge.shared))
        for edge in edges
        if node_id in (edge.a, edge.b)
    ]
    faded = merged.faded.get(node_id)
    return NodeDetails(
        node,
        node_id.map,
        floor_of(merged, floors, node_id),
        node.stamp_ns,
        node.map_from_robot,
        None if placement is None else placement.merged_from_robot,
        None if placement is None else placement.component,
        len(node.landmarks),
        int(node.landmarks.has_depth.sum()),
        () if faded is None else tuple(np.flatnonzero(faded).tolist()),
        len(encode_body(NodePut(node))),
        merged.superseded.get(node_id),
        tuple(sorted(neighbours, key=lambda one: (one.kind, one.node))),
    )
