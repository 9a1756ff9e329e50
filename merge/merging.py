"""Maps and verified links become a merged map: the whole of the merge after verification, as one function.

1. Maps are cut into pieces that their own edges connect.
2. The links between each two pieces, and the loops within one, are sorted by consistency.
3. Pieces are joined, best supported first. Links that would join what is joined already must agree with it.
4. Each component is optimised; a link that then strains more than it should is refused, worst first.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import networkx as nx
import numpy as np

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Array
from hybridmap.pose_arrays import PoseGaussians
from merge.consistency import ConsistencySettings, Sorted, group_links, sort_links
from merge.fragments import Fragment, fragment_by_node, fragments_of
from merge.links import Link, RefusedLink, refuse
from merge.merged import MergedMap, Placement
from merge.posegraph import Measurement, PoseGraph, solve_graph


@dataclass(frozen=True)
class MergeSettings:
    """How maps are merged.

    Attributes:
        consistency: when links are believed.
        strain: chi-square with 3 degrees of freedom above which an optimised link is refused.
    """

    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    strain: float = 25.0


def merge_maps(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    refused: Iterable[RefusedLink] = (),
    settings: MergeSettings | None = None,
) -> MergedMap:
    """Merge.

    Args:
        maps: by id; they are not changed.
        links: verified, at most one a pair of nodes; those at nodes that are not there are left out.
        refused: pairs that were refused before, to be kept with their reasons.
        settings: how.

    Returns:
        The merged map. It does not depend on the order of maps, links or nodes.
    """
    s = settings or MergeSettings()
    fragments = fragments_of(maps)
    by_node = fragment_by_node(fragments)
    present = [link for link in links if link.a in by_node and link.b in by_node]
    refusals = [r for r in refused if r.a in by_node and r.b in by_node]
    groups: dict[tuple[NodeId, NodeId], Sorted] = {}
    for (first, second), group in group_links(present, by_node).items():
        groups[first, second] = sort_links(group, by_node[first], by_node[second], s.consistency)
        refusals += groups[first, second].refused
    kept, more = _join(fragments, by_node, groups, s)
    refusals += more
    solved, kept, more = _optimise(fragments, by_node, kept, s)
    refusals += more
    postures = {
        node: Placement(number, posture)
        for number, graph in enumerate(solved)
        for node, posture in graph.postures().items()
    }
    return MergedMap(
        dict(sorted(maps.items())),
        tuple(sorted((link.canonical() for link in kept), key=lambda link: link.pair)),
        tuple(sorted(refusals, key=lambda r: r.pair)),
        tuple(frozenset(graph.nodes) for graph in solved),
        postures,
        tuple(solved),
    )


def _join(
    fragments: Sequence[Fragment],
    by_node: Mapping[NodeId, Fragment],
    groups: Mapping[tuple[NodeId, NodeId], Sorted],
    s: MergeSettings,
) -> tuple[list[Link], list[RefusedLink]]:
    """Join pieces by their groups of links, best supported first; later ones must agree with earlier ones."""
    joined: nx.Graph = nx.Graph()
    joined.add_nodes_from(fragment.name for fragment in fragments)
    kept: list[Link] = []
    closing: list[Sorted] = []
    ranked = sorted(groups.items(), key=lambda item: (-item[1].weight, item[0]))
    for (first, second), group in ranked:
        if not group.kept:
            continue
        if first == second or not nx.has_path(joined, first, second):
            joined.add_edge(first, second)
            kept += group.kept
        else:
            closing.append(group)
    refusals: list[RefusedLink] = []
    for group in closing:
        solved = {graph.anchor: graph for graph in _solve(fragments, by_node, kept)}
        graph = next(g for g in solved.values() if group.kept[0].a in g.nodes)
        good = _strains(group.kept, graph, s) < s.consistency.gate
        kept += [link for link, fits in zip(group.kept, good, strict=True) if fits]
        refusals += [
            refuse(link, "contradicts better supported links by way of other maps")
            for link, fits in zip(group.kept, good, strict=True)
            if not fits
        ]
    return kept, refusals


def _strains(links: Sequence[Link], graph: PoseGraph, s: MergeSettings) -> Array:
    """(N,) how far links that are not in the graph are from it, chi-square with 3 degrees of freedom."""
    floor = np.diag([s.consistency.floor_xy**2] * 2 + [s.consistency.floor_heading**2])
    measured = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance + floor for link in links]),
    )
    back = graph.relative([link.b for link in links], [link.a for link in links])
    return (measured @ back).distances2()


def _optimise(
    fragments: Sequence[Fragment], by_node: Mapping[NodeId, Fragment], links: list[Link], s: MergeSettings
) -> tuple[list[PoseGraph], list[Link], list[RefusedLink]]:
    """Optimise; refuse the worst link as long as one strains too much."""
    refusals: list[RefusedLink] = []
    while True:
        solved = _solve(fragments, by_node, links)
        place = {node: graph for graph in solved for node in graph.nodes}
        worst, most = None, s.strain
        for link in links:
            relative = place[link.a].pose(link.a).inverse() @ place[link.b].pose(link.b)
            strain = Measurement(link.a, link.b, link.a_from_b)
            d = (link.a_from_b.mean.inverse() @ relative).vector
            value = float(d @ np.linalg.solve(strain.covariance, d))
            if value > most:
                worst, most = link, value
        if worst is None:
            return solved, links, refusals
        links = [link for link in links if link is not worst]
        refusals.append(
            refuse(worst, f"strains the joined map: {most**0.5:.1f} standard deviations from where it ended")
        )


def _solve(
    fragments: Sequence[Fragment], by_node: Mapping[NodeId, Fragment], links: Sequence[Link]
) -> list[PoseGraph]:
    """Each component optimised, largest first, then by name."""
    joined: nx.Graph = nx.Graph()
    joined.add_nodes_from(fragment.name for fragment in fragments)
    joined.add_edges_from((by_node[link.a].name, by_node[link.b].name) for link in links)
    by_name = {fragment.name: fragment for fragment in fragments}
    solved = []
    for names in nx.connected_components(joined):
        anchor = min(names)
        inside = [link for link in links if by_node[link.a].name in names]
        if not inside:
            solved.append(by_name[anchor].graph)
            continue
        measurements = [m for name in sorted(names) for m in by_name[name].measurements]
        measurements += [Measurement(link.a, link.b, link.a_from_b, robust=True) for link in inside]
        solved.append(solve_graph(anchor, by_name[anchor].graph.pose(anchor), measurements))
    return sorted(solved, key=lambda graph: (-len(graph.nodes), graph.anchor))
