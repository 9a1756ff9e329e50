"""The hybrid map: the replay of a log, as a graph that can be searched."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import PoseGaussian

if TYPE_CHECKING:
    import networkx as nx


class HybridMap:
    """Nodes and edges by id, and the undirected reachability graph of the paper.

    Attributes:
        nodes: by id, in the order in which they first came.
        edges: by id; both ends are nodes of this map or, for links between maps, of another.
        graph: networkx multigraph over node ids; each edge's key is its edge id.
    """

    def __init__(self, changes: Iterable[ChangeBody] = ()) -> None:
        """Replay the changes."""
        import networkx as nx

        self.nodes: dict[NodeId, Node] = {}
        self.edges: dict[EdgeId, Edge] = {}
        self.graph: nx.MultiGraph = nx.MultiGraph()
        for body in changes:
            self.apply(body)

    def apply(self, change: ChangeBody) -> None:
        """Apply one change. Retiring what is not there is no error: a log may be replayed from anywhere."""
        match change:
            case NodePut(node):
                self.nodes[node.id] = node
                self.graph.add_node(node.id)
            case NodeRetired(node_id):
                self.nodes.pop(node_id, None)
                if node_id in self.graph:
                    for _, _, edge_id in list(self.graph.edges(node_id, keys=True)):
                        self.edges.pop(edge_id, None)
                    self.graph.remove_node(node_id)
            case EdgePut(edge):
                self._forget_edge(edge.id)
                self.edges[edge.id] = edge
                self.graph.add_edge(edge.a, edge.b, key=edge.id)
            case EdgeRetired(edge_id):
                self._forget_edge(edge_id)

    def _forget_edge(self, edge_id: EdgeId) -> None:
        edge = self.edges.pop(edge_id, None)
        if edge is not None and self.graph.has_edge(edge.a, edge.b, key=edge_id):
            self.graph.remove_edge(edge.a, edge.b, key=edge_id)

    def contents(self) -> Iterator[ChangeBody]:
        """The shortest log that makes this map again: every node, then every edge."""
        for node in self.nodes.values():
            yield NodePut(node)
        for edge in self.edges.values():
            yield EdgePut(edge)

    def components(self) -> list[set[NodeId]]:
        """Connected components over nodes that are really there, largest first."""
        import networkx as nx

        present = self.graph.subgraph(self.nodes)
        return sorted(nx.connected_components(present), key=len, reverse=True)

    def edge_between(self, start: NodeId, end: NodeId) -> PoseGaussian | None:
        """Pose `start_from_end` by the most certain edge between two nodes, or None without an edge."""
        best: PoseGaussian | None = None
        for edge_id in self.graph.get_edge_data(start, end) or ():
            edge = self.edges[edge_id]
            relative = edge.a_from_b if edge.a == start else edge.a_from_b.inverse()
            if best is None or relative.covariance.trace() < best.covariance.trace():
                best = relative
        return best

    def dropped_by(self, body: ChangeBody) -> Iterator[Edge]:
        """Edges that a change would take away or replace."""
        match body:
            case NodeRetired(node_id) if node_id in self.graph:
                for _, _, edge_id in self.graph.edges(node_id, keys=True):
                    yield self.edges[edge_id]
            case EdgePut(edge) if edge.id in self.edges:
                yield self.edges[edge.id]
            case EdgeRetired(edge_id) if edge_id in self.edges:
                yield self.edges[edge_id]
