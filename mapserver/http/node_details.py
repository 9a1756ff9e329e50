"""One node of the merged map, for people: where it is, what it saw, what it costs, what replaces it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.floors import floor_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.codec import encode_body


def node_details(merged: MergedMap, node_id: NodeId, floors: Mapping[MapId, str]) -> dict[str, Any]:
    """Everything about a node, by the names of docs/http.md.

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
        {
            "node": edge.b if edge.a == node_id else edge.a,
            "kind": edge.kind,
            "shared": len(edge.shared),  # landmarks that both ends show
        }
        for edge in edges
        if node_id in (edge.a, edge.b)
    ]
    faded = merged.faded.get(node_id)
    return {
        "node": node,
        "map": node_id.map,
        "floor": floor_of(merged, floors, node_id),
        "stamp_ns": node.stamp_ns,
        "map_from_robot": node.map_from_robot,
        "merged_from_robot": None if placement is None else placement.merged_from_robot,
        "component": None if placement is None else placement.component,
        "landmarks": len(node.landmarks),
        "with_depth": int(node.landmarks.has_depth.sum()),
        "faded": () if faded is None else tuple(np.flatnonzero(faded).tolist()),
        "bytes": len(encode_body(NodePut(node))),
        "superseded": merged.superseded.get(node_id),
        "neighbours": sorted(neighbours, key=lambda one: (one["kind"], one["node"])),
    }
