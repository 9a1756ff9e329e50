"""The hybrid map: the replay of a log, as a graph that can be searched."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
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
    """

    def __init__(self, changes: Iterable[ChangeBody] = ()) -> None:
        self.nodes: dict[NodeId, Node] = {}
        self.edges: dict[EdgeId, Edge] = {}
        # The keys of the edges from each to each; both directions of a pair have the same ones.
        self._between: dict[NodeId, dict[NodeId, dict[EdgeId, None]]] = {}
        for body in changes:
            self.apply(body)

    def apply(self, change: ChangeBody) -> None:
        """Apply one change. Retiring what is not there is no error: a log may be replayed from anywhere."""
        match change:
            case NodePut(node):
                self.nodes[node.id] = node
                self._between.setdefault(node.id, {})
            case NodeRetired(node_id):
                self.nodes.pop(node_id, None)
                for other, edge_ids in self._between.pop(node_id, {}).items():
                    for edge_id in edge_ids:
                        self.edges.pop(edge_id, None)
                    if other != node_id:
                        del self._between[other][node_id]
            case EdgePut(edge):
                self._forget_edge(edge.id)
                self.edges[edge.id] = edge
                between = self._between.setdefault(edge.a, {}).setdefault(edge.b, {})
                self._between.setdefault(edge.b, {})[edge.a] = between
                between[edge.id] = None
            case EdgeRetired(edge_id):
                self._forget_edge(edge_id)

    def _forget_edge(self, edge_id: EdgeId) -> None:
        edge = self.edges.pop(edge_id, None)
        between = self._between.get(edge.a, {}).get(edge.b, {}) if edge is not None else {}
        if edge is None or edge_id not in between:
            return
        del between[edge_id]
        if not between:
            del self._between[edge.a][edge.b]
            if edge.a != edge.b:
                del self._between[edge.b][edge.a]

    def contents(self) -> Iterator[ChangeBody]:
        """The shortest log that makes this map again: every node, then every edge."""
        for node in self.nodes.values():
            yield NodePut(node)
        for edge in self.edges.values():
            yield EdgePut(edge)

    def components(self) -> list[set[NodeId]]:
        """Connected components over nodes that are really there, largest first."""
        found, seen = list[set[NodeId]](), set[NodeId]()
        for node in self._between:
            if node in self.nodes and node not in seen:
                found.append(reached(node, lambda at: (to for to in self._between[at] if to in self.nodes)))
                seen |= found[-1]
        return sorted(found, key=len, reverse=True)

    def graph(self) -> nx.MultiGraph:
        """The reachability graph as it is now, for algorithms of networkx; the key of each edge is its id."""
        # A robot needs none of them, and to import networkx would be a quarter of all that an agent imports.
        import networkx as nx

        graph = nx.MultiGraph()
        graph.add_nodes_from(self._between)
        # With the data: networkx tries the last of three as such, and would take letters of a robot's name.
        graph.add_edges_from((edge.a, edge.b, edge.id, {}) for edge in self.edges.values())
        return graph

    def neighbours(self, node: NodeId) -> Collection[NodeId]:
        """Nodes to which an edge leads from a node, whichever way; none from one that is not there."""
        return self._between.get(node, {}).keys()

    def edges_at(self, node: NodeId) -> list[Edge]:
        """Edges that begin or end at a node; none of one that is not there."""
        return [self.edges[key] for keys in self._between.get(node, {}).values() for key in keys]

    def edges_between(self, start: NodeId, end: NodeId) -> list[Edge]:
        """Edges between two nodes, whichever way they lead."""
        return [self.edges[key] for key in self._between.get(start, {}).get(end, ())]

    def edge_between(self, start: NodeId, end: NodeId) -> PoseGaussian | None:
        """Pose `start_from_end` by the most certain edge between two nodes, or None without an edge."""
        best: PoseGaussian | None = None
        for edge in self.edges_between(start, end):
            relative = edge.a_from_b if edge.a == start else edge.a_from_b.inverse()
            if best is None or relative.covariance.trace() < best.covariance.trace():
                best = relative
        return best

    def dropped_by(self, body: ChangeBody) -> Iterator[Edge]:
        """Edges that a change would take away or replace."""
        match body:
            case NodeRetired(node_id):
                yield from self.edges_at(node_id)
            case EdgePut(edge) if edge.id in self.edges:
                yield self.edges[edge.id]
            case EdgeRetired(edge_id) if edge_id in self.edges:
                yield self.edges[edge_id]


def reached(start: NodeId, neighbours: Callable[[NodeId], Iterable[NodeId]]) -> set[NodeId]:
    """What can be reached from a node, itself included."""
    found, left = {start}, [start]
    while left:
        fresh = {node for node in neighbours(left.pop()) if node not in found}
        found |= fresh
        left += fresh
    return found
