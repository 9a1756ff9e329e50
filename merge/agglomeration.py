"""Maps are joined step by step, best supported first, and each step is evidence for the next.

Two maps that few links join may be joined by many once one of them is part of something larger; of two
stories that are supported alike one may then prevail; and a link that was too little alone may be borne out
by what others have joined. So in each round only pieces are joined of which each is the other's best
supported one. Then the links between the larger pieces are sorted anew, all together, and those within one
piece are tested against it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hybridmap.node import NodeId
from merge.consistency import ConsistencySettings, Sorted, group_links, sort_links
from merge.credence import standpoints
from merge.fragments import Fragment, fragment_by_node
from merge.groups import LinkGroup
from merge.joining import Solver, misfits
from merge.links import Link, RefusedLink, refuse
from merge.posegraph import PoseGraph

Key = tuple[NodeId, NodeId]
"""Names of two pieces of map, smaller first."""

CONTRADICTION = "contradicts better supported links by way of other maps"


def agglomerate(
    solver: Solver, groups: Mapping[Key, LinkGroup], s: ConsistencySettings
) -> tuple[list[Link], list[RefusedLink]]:
    """Join fragments by their groups of links.

    Args:
        solver: of the fragments.
        groups: by the names of the fragments.
        s: when links are believed.

    Returns:
        The links that join, and those that do not; what a group has refuted is in neither.
    """
    kept = [link for group in groups.values() for link in group.sorted.kept if group.first is group.second]
    if not s.cliques:
        return [link for group in groups.values() for link in group.sorted.kept], []
    refused = {r.pair: r for group in groups.values() for r in group.sorted.refused}
    waiting = [link for group in groups.values() for link in group.links if group.first is not group.second]
    agreed = {link.canonical().pair for group in groups.values() for link in group.sorted.kept}
    while True:
        by_node = fragment_by_node([Fragment(graph.anchor, graph, ()) for graph in solver.solve(kept)])
        inside = [link for link in waiting if by_node[link.a] is by_node[link.b]]
        waiting = [link for link in waiting if by_node[link.a] is not by_node[link.b]]
        borne_out = _borne_out(inside, by_node, agreed, s)
        kept += borne_out
        fits = {link.pair for link in borne_out}
        for link in inside:
            if link.pair not in fits:
                refused.setdefault(link.canonical().pair, refuse(link, CONTRADICTION))
        pooled = {
            key: _sorted(links, key, groups, by_node, s)
            for key, links in group_links(waiting, by_node).items()
        }
        joined = _joined(pooled)
        if not joined:
            break
        kept += [link for key in joined for link in pooled[key].kept]
        through = {link.canonical().pair for key in joined for link in pooled[key].kept}
        waiting = [link for link in waiting if link.canonical().pair not in through]
    for found in pooled.values():
        refused |= {r.pair: r for r in found.refused if r.pair not in refused}
    told = {link.canonical().pair for link in kept}
    return kept, [r for pair, r in refused.items() if pair not in told]


def _sorted(
    links: Sequence[Link],
    key: Key,
    groups: Mapping[Key, LinkGroup],
    by_node: Mapping[NodeId, Fragment],
    s: ConsistencySettings,
) -> Sorted:
    """Sort the links between two pieces; what a group is by itself has been found out already."""
    group = groups.get(key)
    first, second = by_node[key[0]], by_node[key[1]]
    if group is not None and len(group.first) == len(first) and len(group.second) == len(second):
        return group.sorted
    return sort_links(links, first, second, s)


def _joined(pooled: Mapping[Key, Sorted]) -> list[Key]:
    """Which pieces are joined in this round: those of which each is the other's best supported one."""
    ranked = [key for key, found in sorted(pooled.items(), key=lambda x: (-x[1].weight, x[0])) if found.kept]
    best: dict[NodeId, Key] = {}
    for key in ranked:
        for name in key:
            best.setdefault(name, key)
    return [key for key in ranked if best[key[0]] == best[key[1]] == key]


def _borne_out(
    links: Sequence[Link],
    by_node: Mapping[NodeId, Fragment],
    agreed: set[tuple[NodeId, NodeId]],
    s: ConsistencySettings,
) -> list[Link]:
    """The links within pieces that these bear out: they fit, and unless others of their group agree with
    them, that they fit is more than chance.
    """
    inside: dict[NodeId, tuple[PoseGraph, list[Link]]] = {}
    for link in links:
        piece = by_node[link.a]
        inside.setdefault(piece.name, (piece.graph, []))[1].append(link)
    out: list[Link] = []
    for graph, here in inside.values():
        fits = misfits(here, graph, s) < s.gate
        known = standpoints(here, graph, kept=False)
        out += [
            link
            for link, good, found in zip(here, fits, known, strict=True)
            if good and (link.canonical().pair in agreed or found.log_factor > s.least_evidence)
        ]
    return out
