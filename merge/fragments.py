"""Fragments: the connected pieces of the maps before anything is joined."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import networkx as nx

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from merge.posegraph import Measurement, PoseGraph, solve_graph


@dataclass(frozen=True, eq=False)
class Fragment:
    """Nodes of one map that its own edges connect, with the postures that these edges give.

    Attributes:
        name: the smallest id in it.
        graph: solved postures; the smallest id is held at its own posture.
        measurements: the edges.
    """

    name: NodeId
    graph: PoseGraph
    measurements: tuple[Measurement, ...]

    @property
    def nodes(self) -> tuple[NodeId, ...]:
        """In the order of ids."""
        return self.graph.nodes

    def __len__(self) -> int:
        """How many nodes."""
        return len(self.graph.nodes)


def fragments_of(maps: Mapping[MapId, HybridMap]) -> list[Fragment]:
    """Cut maps into connected pieces, each solved by itself, in the order of names.

    Args:
        maps: by id. Edges whose ends are not both nodes of the same map are not theirs to say and are left
            out: maps are joined by links alone.
    """
    found = []
    for map_id in sorted(maps):
        one = maps[map_id]
        own = [edge for edge in one.edges.values() if edge.a in one.nodes and edge.b in one.nodes]
        graph: nx.Graph = nx.Graph()
        graph.add_nodes_from(one.nodes)
        graph.add_edges_from((edge.a, edge.b) for edge in own if edge.a != edge.b)
        for piece in nx.connected_components(graph):
            name = min(piece)
            measurements = tuple(
                Measurement(edge.a, edge.b, edge.a_from_b)
                for edge in sorted(own, key=lambda edge: edge.id)
                if edge.a in piece and edge.a != edge.b
            )
            solved = solve_graph(name, one.nodes[name].map_from_robot.mean, measurements)
            found.append(Fragment(name, solved, measurements))
    return sorted(found, key=lambda fragment: fragment.name)


def fragment_by_node(fragments: Collection[Fragment]) -> dict[NodeId, Fragment]:
    """Which fragment each node belongs to."""
    return {node: fragment for fragment in fragments for node in fragment.nodes}
