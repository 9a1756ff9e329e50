"""A map as a networkx graph: places and edges with their numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import networkx as nx
import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Pose2

Numbers = Mapping[str, float]


def graph_of(
    nodes: Mapping[NodeId, Node],
    placed: Mapping[NodeId, tuple[int, Pose2]],
    edges: Iterable[Edge],
    numbers: Callable[[Edge], Numbers],
) -> nx.MultiGraph[str]:
    """The graph of a map; its values are text and numbers alone, as GraphML takes them.

    Nodes are named as people write them (`r0.1.17`), keys of edges likewise. A node has `map`, `component`,
    `x`, `y` (m), `heading` (rad), `stamp_ns` and `landmarks`. An edge has `kind`, `length` (m), and the pose
    of its other end in its end `a` as `x`, `y`, `heading` with `sigma_xy` and `sigma_heading`.

    Args:
        nodes: by id.
        placed: component and pose in its frame; nodes without are left out, and their edges.
        edges: among the nodes.
        numbers: more numbers of an edge.
    """
    graph: nx.MultiGraph[str] = nx.MultiGraph()
    for node_id in sorted(nodes.keys() & placed.keys()):
        node, (component, pose) = nodes[node_id], placed[node_id]
        x, y, heading = (float(value) for value in pose.vector)
        graph.add_node(
            str(node_id), map=str(node_id.map), component=component, x=x, y=y, heading=heading,
            stamp_ns=node.stamp_ns, landmarks=len(node.landmarks),
        )  # fmt: skip
    for edge in edges:
        a, b = str(edge.a), str(edge.b)
        if a not in graph or b not in graph:
            continue
        x, y, heading = (float(value) for value in edge.a_from_b.mean.vector)
        sigma = np.sqrt(np.diag(edge.a_from_b.covariance))
        graph.add_edge(
            a, b, key=str(edge.id), kind=str(edge.kind), a=a, x=x, y=y, heading=heading,
            length=float(np.hypot(x, y)), sigma_xy=float(sigma[:2].max()), sigma_heading=float(sigma[2]),
            shared=len(edge.shared), **numbers(edge),
        )  # fmt: skip
    return graph
