"""Retired nodes: which nodes constraints retire, and a robot's map without them.

A retired node shows nothing any more. But its robot has driven by, and that measured how the nodes before and
after it lie to each other. So its map gets a bridge: a measurement between these two, composed of the edges
across the retired node. Of a longer stretch likewise, along the fewest edges. Where several nodes border on
one stretch, bridges lead from the first of them to each other one; errors that they have in common are
counted for each, so poses are never made surer than they are. Bridges tie poses; no route leads over them.
Loop closures at a retired node show what it shows, and go with it: if nothing else ties two parts of a map,
it falls into pieces.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import networkx as nx
import numpy as np

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import RetiredArea, RetiredNodes, RetiredWindow
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.solved_graph import PoseGraph

BRIDGE_AUTHOR = "bridge"
"""Takes the agent's place in the ids of bridges."""


def retired_nodes(
    maps: Mapping[MapId, HybridMap], constraints: ManualConstraints, graphs: Sequence[PoseGraph]
) -> dict[NodeId, ManualConstraint]:
    """Nodes that are retired, with the constraint that retires each; of retired maps none.

    Args:
        maps: by id.
        constraints: manual constraints.
        graphs: components of the merge without retired areas, which say what lies in them. An area whose
            anchor is in none of them retires nothing.
    """
    out: dict[NodeId, ManualConstraint] = {}
    for constraint in constraints.in_force:
        for node in _retired_by(constraint, maps, graphs):
            if node.map in maps and node.map not in constraints.retired:
                out.setdefault(node, constraint)
    return out


def _retired_by(
    constraint: ManualConstraint, maps: Mapping[MapId, HybridMap], graphs: Sequence[PoseGraph]
) -> Collection[NodeId]:
    match constraint.about:
        case RetiredNodes(nodes):
            return [node for node in nodes if node.map in maps and node in maps[node.map].nodes]
        case RetiredWindow(which) as window if which in maps:
            return [node.id for node in maps[which].nodes.values() if window.holds(node)]
        case RetiredArea(area):
            for graph in graphs:
                if area.anchor in graph.rows:
                    in_anchor = graph.pose(area.anchor).inverse().apply(graph.means[:, :2])
                    return [graph.nodes[k] for k in np.flatnonzero(area.contains(in_anchor)).tolist()]
    return []


def without_nodes(hybrid_map: HybridMap, retired: Collection[NodeId]) -> HybridMap:
    """A robot's map without some nodes, with bridges across them."""
    kept = HybridMap()
    for change in hybrid_map.contents():
        match change:
            case NodePut(node) if node.id not in retired:
                kept.apply(change)
            case EdgePut(edge) if edge.a not in retired and edge.b not in retired:
                kept.apply(change)
    for bridge in _bridges(hybrid_map, retired):
        kept.apply(EdgePut(bridge))
    return kept


def _bridges(hybrid_map: HybridMap, retired: Collection[NodeId]) -> list[Edge]:
    """Measurements across retired nodes, composed of the robot's own way."""
    way: nx.Graph = nx.Graph()
    for edge in hybrid_map.edges.values():
        if edge.kind not in CLAIMS and edge.a in hybrid_map.nodes and edge.b in hybrid_map.nodes:
            way.add_edge(edge.a, edge.b)
    stretches = nx.connected_components(way.subgraph(node for node in retired if node in way))
    bridges: list[Edge] = []
    for stretch in sorted(stretches, key=min):
        rim = sorted({neighbour for node in stretch for neighbour in way[node]} - stretch)
        if len(rim) < 2:
            continue
        across: nx.Graph = nx.Graph(way.subgraph(stretch | {*rim}))
        # Ways from one rim node to another without a retired node between have their own edges.
        across.remove_edges_from([(a, b) for a, b in across.edges if a not in stretch and b not in stretch])
        ways = nx.single_source_shortest_path(across, rim[0])
        for other in rim[1:]:
            number = len(bridges)
            measured = _composed(hybrid_map, ways[other])
            bridges.append(Edge(EdgeId(BRIDGE_AUTHOR, 0, number), rim[0], other, measured, EdgeKind.MAPPED))
    return bridges


def _composed(hybrid_map: HybridMap, way: Sequence[NodeId]) -> PoseGaussian:
    """The pose of the last node of a way in the first one's frame."""
    steps = [_way_between(hybrid_map, a, b) for a, b in pairwise(way)]
    total = steps[0]
    for step in steps[1:]:
        total = total @ step
    return total


def _way_between(hybrid_map: HybridMap, a: NodeId, b: NodeId) -> PoseGaussian:
    """Pose `a_from_b` by the most certain edge of the robot's way between two neighbours."""
    best = min(
        (edge for edge in hybrid_map.edges_between(a, b) if edge.kind not in CLAIMS),
        key=lambda edge: (float(edge.a_from_b.covariance.trace()), edge.id),
    )
    return best.a_from_b if best.a == a else best.a_from_b.inverse()
