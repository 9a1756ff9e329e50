"""Drives among the nodes of others: they show that a robot can get through, not where nodes are.

A robot that follows a route through the merged map records in its own log that it got from node to node. The
relative pose of nodes of different maps comes from their landmarks, which can be verified again. So such an
edge takes no part in the merge; it is only checked against the result.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.factors import LOOP_FLOOR
from mapweave.merge.pose_graph.links import RefusedLink, refuse_edge
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ConsistencySettings

VAGUE = np.array([0.6, 0.6, 0.2])
"""m, m, rad: an edge known no better does not even show that the servo got there. Four of these are its
range, see `mapweave.hybridmap.reachability`. Robots report none above 0.1 m."""


def refuse_drives(
    maps: Mapping[MapId, HybridMap], graphs: Sequence[PoseGraph], s: ConsistencySettings
) -> list[RefusedLink]:
    """Find the edges with an end in another map that the merged map does not bear out.

    Args:
        maps: by id.
        graphs: of the merged map, one a component.
        s: when measurements agree.

    Returns:
        Those that lead to nodes that are not there, that join what is not joined, that measured what the
        merged map contradicts, or hardly anything.
    """
    refusals = []
    for map_id, hybrid_map in sorted(maps.items()):
        for edge in sorted(hybrid_map.edges.values(), key=lambda edge: edge.id):
            reason = "" if edge.a.map == edge.b.map == map_id else _objection(edge, graphs, s)
            if reason:
                refusals.append(refuse_edge(edge, f"a drive {reason}"))
    return refusals


def _objection(edge: Edge, graphs: Sequence[PoseGraph], s: ConsistencySettings) -> str:
    graph = next((graph for graph in graphs if edge.a in graph.rows and edge.b in graph.rows), None)
    if graph is None:
        placed = {node for graph in graphs for node in (edge.a, edge.b) if node in graph.rows}
        return "joins maps that nothing else joins" if len(placed) == 2 else "leads to a node that is gone"
    if (np.diag(edge.a_from_b.covariance) > VAGUE**2).any():
        return f"measured no better than {VAGUE[0]:g} m and {VAGUE[2]:g} rad"
    merged = graph.relative([edge.a], [edge.b])
    spread = edge.a_from_b.covariance + merged.covariances[0] + LOOP_FLOOR
    off = PoseGaussian(edge.a_from_b.mean, spread).mahalanobis2(Pose2.from_vector(merged.means[0]))
    return "" if off < s.gate else "contradicts the merged map"
