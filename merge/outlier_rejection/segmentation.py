"""Segmentation of maps into fragments, and tests of each robot's own loop closures.

A drive or turn from one node to the next while mapping was measured all the way. A recognised place (`loop`)
is less certain: in a warehouse the next bay looks like this one. So is a drive between two places that were
recognised later (`driven`). So a robot's own loop closures join the pieces of its drive just as links join
maps: sorted by consistency. Two things differ. A single one is enough, since the drive supports it. And a map
is never torn apart: where a robot resumed its map elsewhere, loop closures alone connect the new part with
the old one.
"""

from collections.abc import Mapping
from dataclasses import replace

import networkx as nx

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.merge.outlier_rejection.closing_links import join
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS, sort_loop_closures
from mapweave.merge.outlier_rejection.pairwise_consistency import DOMINANCE, group_links, sort_links
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import RefusedLink, link_of
from mapweave.merge.settings import ConsistencySettings

WORDS = {EdgeKind.LOOP: "loop", EdgeKind.MERGED: "link", EdgeKind.DRIVEN: "drive"}


def fragments_of(
    maps: Mapping[MapId, HybridMap], consistency: ConsistencySettings | None = None
) -> list[Fragment]:
    """Cut maps into connected pieces, each solved by itself, in the order of names.

    Args:
        maps: by id. Edges whose ends are not both nodes of the same map are left
            out: maps are joined by links alone.
        consistency: when a robot's own loop closures are accepted.
    """
    s = consistency or ConsistencySettings()
    fragments = [piece for map_id in sorted(maps) for piece in _pieces(maps[map_id], s)]
    return sorted(fragments, key=lambda fragment: fragment.name)


def _pieces(hybrid_map: HybridMap, s: ConsistencySettings) -> list[Fragment]:
    """The fragments of one map."""
    own = sorted(
        (
            edge
            for edge in hybrid_map.edges.values()
            if edge.a in hybrid_map.nodes and edge.b in hybrid_map.nodes and edge.a != edge.b
        ),
        key=lambda edge: edge.id,
    )
    strands = _strands(hybrid_map, [edge for edge in own if edge.kind not in CLAIMS])
    claims, refusals = sort_loop_closures(own, s)
    if not claims:
        return strands
    solver = ComponentSolver(strands)
    loops = sorted((link_of(edges[0]) for edges in claims.values()), key=lambda link: link.pair)
    single = replace(s, least_links=1)
    groups = {}
    refused: list[RefusedLink] = []
    for (first, second), links in group_links(loops, solver.by_node).items():
        pair = solver.by_node[first], solver.by_node[second]
        groups[first, second] = sort_links(links, *pair, single, DOMINANCE if first == second else 0.0)
        refused += groups[first, second].refused
    kept, more = join(solver, groups, s)
    refused += more
    refusals += [
        replace(r, reason=f"the robot's own {WORDS[edge.kind]} {r.reason}", edge=edge.id)
        for r in refused
        for edge in claims[r.pair]
    ]
    pieces = []
    for graph in solver.solve(kept, whole=True):
        inside = [strand for strand in strands if strand.name in graph.rows]
        measurements = [m for strand in inside for m in strand.measurements]
        measurements += [RelativePose(*k.pair, k.a_from_b, robust=True) for k in kept if k.a in graph.rows]
        about = sorted((r for r in refusals if r.a in graph.rows), key=lambda r: (r.pair, str(r.edge)))
        pieces.append(Fragment(graph.anchor, graph, tuple(measurements), tuple(about)))
    return pieces


def _strands(hybrid_map: HybridMap, edges: list[Edge]) -> list[Fragment]:
    """What a map's way alone connects."""
    graph: nx.Graph = nx.Graph()
    graph.add_nodes_from(hybrid_map.nodes)
    graph.add_edges_from((edge.a, edge.b) for edge in edges)
    names = {node: min(piece) for piece in nx.connected_components(graph) for node in piece}
    measurements: dict[NodeId, list[RelativePose]] = {name: [] for name in sorted(set(names.values()))}
    for edge in edges:
        measurements[names[edge.a]].append(RelativePose(edge.a, edge.b, edge.a_from_b))
    return [
        Fragment(name, solve_graph(name, hybrid_map.nodes[name].map_from_robot.mean, inside), tuple(inside))
        for name, inside in measurements.items()
    ]
