"""Maps are joined step by step, best supported first, and each step is evidence for the next.

Two maps with few links may be joined by many once one of them is part of a larger piece; of two contradicting
sets with equal support one may then win; and an isolated link may be confirmed by what others have joined. So
each round joins only pieces that are each other's best supported partner. Then the links between the larger
pieces are sorted again, all together, and those within one piece are tested against it.
"""

from collections.abc import Container, Mapping, Sequence, Set

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.outlier_rejection.fleet_chance import FleetChance, chance_by_map
from mapweave.merge.outlier_rejection.link_groups import LinkGroup
from mapweave.merge.outlier_rejection.link_probability import standpoints
from mapweave.merge.outlier_rejection.pairwise_consistency import (
    LEAST_EVIDENCE,
    Sorted,
    group_links,
    sort_links,
)
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment, fragment_by_node
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ConsistencySettings

Key = tuple[NodeId, NodeId]
"""Names of two pieces of map, smaller first."""

MOST_POOLED = 200
"""Links between two components that are sorted together, the best supported ones; the others are tested
against what these join. All pairs of them are compared."""
CONTRADICTION = "contradicts better supported links by way of other maps"


def agglomerate(
    solver: ComponentSolver,
    groups: Mapping[Key, LinkGroup],
    s: ConsistencySettings,
    standing: Sequence[Link] = (),
    closed: Set[Key] = frozenset(),
) -> tuple[list[Link], list[RefusedLink]]:
    """Join fragments by their groups of links.

    Args:
        solver: of the fragments.
        groups: by the names of the fragments.
        s: when links are accepted.
        standing: links that are accepted already; the others are tested against what they join.
        closed: pairs of links that are not asked: they were refused, and nothing near them has changed.

    Returns:
        The links that join, and those that do not; what a group has refuted or what is closed is in neither.
    """
    kept = list(standing)
    keys = {link.key for link in kept} | closed
    asked = {key: [k for k in group.links if k.key not in keys] for key, group in groups.items()}
    asked = {key: links for key, links in asked.items() if links}
    for key in asked:
        if groups[key].first is groups[key].second:
            kept += [link for link in groups[key].sorted.kept if link.key not in keys]
    refused = {r.pair: r for key in asked for r in groups[key].sorted.refused if r.pair not in keys}
    waiting = [link for key, links in asked.items() if key[0] != key[1] for link in links]
    between = {key: group for key, group in groups.items() if group.first is not group.second}
    chance = chance_by_map(groups.values(), standing)
    sorted_before: dict[Key, tuple[PoseGraph, PoseGraph, int, Sorted]] = {}
    while True:
        by_node = fragment_by_node([Fragment(graph.anchor, graph, ()) for graph in solver.solve(kept)])
        inside = [link for link in waiting if by_node[link.a] is by_node[link.b]]
        waiting = [link for link in waiting if by_node[link.a] is not by_node[link.b]]
        borne_out = _borne_out(inside, by_node, chance, s)
        kept += borne_out
        fits = {link.pair for link in borne_out}
        for link in inside:
            if link.pair not in fits:
                refused.setdefault(link.key, refuse(link, CONTRADICTION))
        pools = group_links(waiting, by_node)
        if not pools:
            break
        own: dict[Key, list[LinkGroup]] = {}
        for (a, b), group in between.items():
            first, second = sorted((by_node[a].name, by_node[b].name))
            own.setdefault((first, second), []).append(group)
        pooled = {}
        for key, links in pools.items():
            first_graph, second_graph = (by_node[name].graph for name in key)
            cached = sorted_before.get(key)
            if cached is None or cached[:3] != (first_graph, second_graph, len(links)):
                sorted_links = _sorted(links, key, groups, by_node, s)
                cached = sorted_before[key] = first_graph, second_graph, len(links), sorted_links
            pooled[key] = chance[key[0].map].beyond(cached[3], own[key], s)
        chosen = joined(
            {key: sorted_links.weight for key, sorted_links in pooled.items() if sorted_links.kept}, pooled
        )
        if not chosen:
            for key, sorted_links in pooled.items():
                refused = {**{r.pair: r for r in sorted_links.refused}, **refused}
                for link in pools[key]:
                    refused.setdefault(link.key, refuse(link, sorted_links.refused[0].reason))
            break
        kept += [link for key in chosen for link in pooled[key].kept]
        through = {link.key for key in chosen for link in pooled[key].kept}
        waiting = [link for link in waiting if link.key not in through]
    keys = {link.key for link in kept}
    left = [link for links in asked.values() for link in links if link.key not in keys]
    kept = _with_borne_out(solver, kept, left, chance, s)
    keys = {link.key for link in kept}
    return kept, [r for pair, r in refused.items() if pair not in keys]


def _with_borne_out(
    solver: ComponentSolver,
    kept: Sequence[Link],
    refused: Sequence[Link],
    chance: Mapping[MapId, FleetChance],
    s: ConsistencySettings,
) -> list[Link]:
    """Kept links, with the refused ones that the joined map bears out after all, until there is none.

    Of hundreds of links that are right some two will miss each other's gate by chance, and a clique keeps but
    one of them. What all others make of the map is a better judge than any one of them.
    """
    kept, refused = list(kept), list(refused)
    while refused:
        by_node = fragment_by_node([Fragment(graph.anchor, graph, ()) for graph in solver.solve(kept)])
        inside = [link for link in refused if by_node[link.a] is by_node[link.b]]
        back = _borne_out(inside, by_node, chance, s)
        if not back:
            return kept
        kept += back
        pairs = {link.key for link in back}
        refused = [link for link in refused if link.key not in pairs]
    return kept


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
    best = sorted(links, key=lambda link: (-link.weight, link.pair))[:MOST_POOLED]
    return sort_links(best, first, second, s)


def best_supported(weights: Mapping[Key, float]) -> dict[NodeId, Key]:
    """For each piece the two that are joined by the greatest weight: it and another one."""
    best: dict[NodeId, Key] = {}
    for key in _ranked(weights):
        for piece in key:
            best.setdefault(piece, key)
    return best


def joined(weights: Mapping[Key, float], tied: Container[Key]) -> list[Key]:
    """Which pieces are joined in this round: those of which each is the other's best supported one.

    A piece of which the other one has a better supported one is joined to it too, if no links at all tie it
    to any of those: then they are independent, and their order does not matter.

    Args:
        weights: behind the links that would join two pieces, the smaller first.
        tied: pieces between which there are links at all.

    Returns:
        Best supported first.
    """
    best = best_supported(weights)
    better: dict[NodeId, list[NodeId]] = {}
    out = []
    for key in _ranked(weights):
        for a, b in (key, key[::-1]):
            if best[a] == key and not any(
                (min(a, rival), max(a, rival)) in tied for rival in better.get(b, ())
            ):
                out.append(key)
                break
        for a, b in (key, key[::-1]):
            better.setdefault(a, []).append(b)
    return out


def _ranked(weights: Mapping[Key, float]) -> list[Key]:
    return sorted(weights, key=lambda key: (-weights[key], key))


def _borne_out(
    links: Sequence[Link],
    by_node: Mapping[NodeId, Fragment],
    chance: Mapping[MapId, FleetChance],
    s: ConsistencySettings,
) -> list[Link]:
    """The links within pieces that these bear out: likely ones to which they can be bent without strain."""
    inside: dict[NodeId, tuple[PoseGraph, list[Link]]] = {}
    for link in links:
        piece = by_node[link.a]
        inside.setdefault(piece.name, (piece.graph, []))[1].append(link)
    out: list[Link] = []
    for graph, inside_links in inside.values():
        least = max(0.0, LEAST_EVIDENCE - chance[inside_links[0].a.map].every.log_odds)
        rated = standpoints(inside_links, graph, kept=False)
        out += [
            link
            for link, one in zip(inside_links, rated, strict=True)
            if one.log_factor > least and one.residual2 < s.gate
        ]
    return out
