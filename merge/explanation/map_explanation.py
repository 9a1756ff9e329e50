"""Explanations of two maps: why they are one, or are not, and which nodes came nearest to joining them."""

import heapq
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import networkx as nx

from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.explanation import MapsExplanation, NearMiss
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import reason_of, retired_words
from mapweave.hybridmap.reachability import reachability_of
from mapweave.merge.explanation.component_changes import joined_maps
from mapweave.merge.explanation.map_standing import all_refused, only_similar
from mapweave.merge.explanation.node_explanation import node_of
from mapweave.merge.explanation.own_edges import reach_words
from mapweave.merge.explanation.twin_maps import TWINS, are_twins
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import examine
from mapweave.registration.matching import match
from mapweave.registration.recognition import RecognitionSettings

Pair = tuple[MapId, MapId]
MOST_NEAR = 5
"""Pairs that are listed for each two maps."""
CLOSELY = 16
"""Pairs of maps of a fleet that are examined closely: comparing similar nodes once more takes 50 ms each."""


def explain_maps(merged: MergedMap, first: MapId, second: MapId) -> MapsExplanation:
    """Explain two maps.

    Raises:
        InvalidValue: the same map twice, or one that is not there.
    """
    for one in (first, second):
        merged.check(one)
    if first == second:
        raise InvalidValue(f"{first} twice: give two maps")
    pair = min(first, second), max(first, second)
    return _explained(merged, pair, _between(merged, [pair])[pair], merged.joined(*pair), True)


def explain_fleet(merged: MergedMap, most: int) -> tuple[MapsExplanation, ...]:
    """Explain each two maps: those first that are not one, of these those with the most refused links, and
    last those of which one is retired.

    Args:
        merged: the merged map.
        most: pairs at most.
    """
    part_of = {map_id: number for number, part in enumerate(joined_maps(merged)) for map_id in part}
    refused: Counter[Pair] = Counter()
    alike: Counter[Pair] = Counter()
    for r in merged.refused:
        if r.a.map != r.b.map:
            (alike if r.link is None else refused)[min(r.a.map, r.b.map), max(r.a.map, r.b.map)] += 1

    retired = merged.constraints.retired

    def interest(pair: Pair) -> tuple[bool, bool, int, int, Pair]:
        first, second = (part_of.get(map_id) for map_id in pair)
        joined = first is not None and first == second
        return joined, not retired.keys().isdisjoint(pair), -refused[pair], -alike[pair], pair

    pairs = heapq.nsmallest(most, combinations(sorted(merged.maps), 2), key=interest)
    between = _between(merged, pairs)
    components = [{node.map for node in component} for component in merged.components]
    return tuple(
        _explained(
            merged,
            pair,
            between[pair],
            any(map_id.issuperset(pair) for map_id in components),
            k < CLOSELY,
        )
        for k, pair in enumerate(pairs)
    )


@dataclass(frozen=True)
class _Between:
    """What was found between two maps."""

    links: list[Link] = field(default_factory=list)
    refused: list[RefusedLink] = field(default_factory=list)
    unverified: list[RefusedLink] = field(default_factory=list)


def _between(merged: MergedMap, pairs: Collection[Pair]) -> dict[Pair, _Between]:
    """What lies between all pairs at once: a large fleet has many refusals."""
    out = {pair: _Between() for pair in pairs}
    for link in merged.links:
        if between := out.get((min(link.a.map, link.b.map), max(link.a.map, link.b.map))):
            between.links.append(link)
    for r in merged.refused:
        if r.edge is None and (between := out.get((min(r.a.map, r.b.map), max(r.a.map, r.b.map)))):
            (between.unverified if r.link is None else between.refused).append(r)
    return out


def _explained(
    merged: MergedMap,
    pair: Pair,
    between: _Between,
    joined: bool,
    closely: bool,
) -> MapsExplanation:
    """What is said of two maps; only a close examination compares similar pairs once more."""
    links, refused = between.links, between.refused
    if joined:
        nearest = _weakest(merged, links)
    else:
        nearest = _strongest(refused)
        if closely and len(nearest) < MOST_NEAR:
            nearest = (*nearest, *_most_alike(merged, between.unverified))[:MOST_NEAR]
    over = _over(merged, *pair) if joined and not links else ()
    reason = (
        _why_joined(merged, *pair, links, over)
        if joined
        else _why_apart(merged, *pair, refused, between.unverified, nearest)
    )
    return MapsExplanation(
        *pair,
        joined,
        reason,
        len(links),
        sum(link.weight for link in links),
        len(refused),
        len(between.unverified),
        nearest,
        merged.constraints.about(*pair),
        over,
    )


def _over(merged: MergedMap, first: MapId, second: MapId) -> tuple[MapId, ...]:
    """The fewest maps over which links join two."""
    graph: nx.Graph = nx.Graph((link.a.map, link.b.map) for link in merged.links)
    # A map may be in several pieces, so a way over maps is only a hint.
    way = nx.shortest_path(graph, first, second) if first in graph and second in graph else [first, second]
    return tuple(way[1:-1])


def _why_joined(
    merged: MergedMap, first: MapId, second: MapId, links: Sequence[Link], over: Sequence[MapId]
) -> str:
    if links:
        landmarks = sum(link.weight for link in links)
        many = "1 link joins" if len(links) == 1 else f"{len(links)} links join"
        driven = sum(_drivable(merged, link) for link in links)
        ways = f"{driven} of them can be driven" if driven else "they tie poses, none can be driven"
        return f"{first} and {second} are one map: {many} them, with {landmarks} landmarks behind; {ways}"
    way = ", ".join(map(str, over)) or "each other's pieces"
    apart = merged.constraints.standing(Apart((first, second))) is not None
    more = ", by a manual constraint; to separate them undo the links of that way too" if apart else ""
    return f"{first} and {second} are one map by way of {way}; no link joins the two directly{more}"


def _drivable(merged: MergedMap, link: Link) -> bool:
    edge = link.edge()
    return reachability_of(edge, node_of(merged, edge.a), node_of(merged, edge.b)).drivable


def _why_apart(
    merged: MergedMap,
    first: MapId,
    second: MapId,
    refused: Sequence[RefusedLink],
    unverified: Sequence[RefusedLink],
    nearest: Sequence[NearMiss],
) -> str:
    head = f"{first} and {second} are not one map"
    constraints = merged.constraints
    if retired := [words for one in (first, second) if (words := _retired(merged, one))]:
        return f"{head}: {'; '.join(retired)}"
    constraint = constraints.standing(Apart((first, second)))
    if constraint is not None:
        return f"{head}: {reason_of(constraint)}"
    if refused:
        reasons = Counter(r.reason for r in refused)
        reasons_in_words = [
            reason if count == len(refused) else f"{reason} ({count} of them)"
            for reason, count in reasons.most_common(2)
        ]
        twins = f". They show the same places: {TWINS}" if are_twins(refused) else ""
        return f"{head}: {all_refused(len(refused))}: {'; '.join(reasons_in_words)}{twins}"
    if unverified:
        best = f"; nearest are {nearest[0].a} and {nearest[0].b}: {nearest[0].lacks}" if nearest else ""
        return f"{head}: {only_similar(len(unverified))}{best}"
    return f"{head}: no node of one shares enough similar features with any of the other to be compared"


def _retired(merged: MergedMap, which: MapId) -> str:
    """Who has retired a map, as a whole or by all of its nodes, and how it comes back; else empty."""
    constraints = merged.constraints
    if which in constraints.retired:
        return retired_words(constraints.retired[which])
    retiring = [constraints.nodes.get(node) for node in merged.maps[which].nodes]
    by = dict.fromkeys(one for one in retiring if one is not None)
    if not by or None in retiring:
        return ""
    return f"no node of {which} is left: {'; '.join(retired_words(one) for one in by)}"


def _strongest(refused: Sequence[RefusedLink]) -> tuple[NearMiss, ...]:
    """Refused links with the most landmarks behind them that are found nowhere else."""
    links = [(refusal.link, refusal.reason) for refusal in refused if refusal.link is not None]
    links.sort(key=lambda item: (-item[0].weight, item[0].pair))
    return tuple(_near_miss(link, reason) for link, reason in links[:MOST_NEAR])


def _weakest(merged: MergedMap, links: Sequence[Link]) -> tuple[NearMiss, ...]:
    """Accepted links with the fewest landmarks: the weakest of a merge."""
    few = sorted(links, key=lambda link: (link.weight, link.pair))[:MOST_NEAR]
    return tuple(_near_miss(link, reach_words(merged, link.edge())) for link in few)


def _near_miss(link: Link, words: str) -> NearMiss:
    inliers = int(link.evidence.get("inliers", link.weight))
    if link.aliased:
        words = f"{link.aliased} of these are found at other places too; {words}"
    return NearMiss(*link.pair, int(link.evidence.get("matches", inliers)), inliers, words)


def _most_alike(merged: MergedMap, unverified: Sequence[RefusedLink]) -> tuple[NearMiss, ...]:
    """Pairs without a common pose that share the most similar landmarks, compared once more."""
    s = RecognitionSettings()
    alike: list[tuple[int, NodeId, NodeId, str]] = []
    for refusal in unverified:
        a, b = node_of(merged, refusal.a), node_of(merged, refusal.b)
        matches = match(a.landmarks.codes, b.landmarks.codes, s.matching)
        alike.append((len(matches), a.id, b.id, refusal.reason))
    alike.sort(key=lambda item: (-item[0], item[1:]))
    out = []
    for count, a_id, b_id, reason in alike[:MOST_NEAR]:
        verdict = examine(node_of(merged, a_id), node_of(merged, b_id), s)
        inliers = verdict.inliers
        out.append(NearMiss(a_id, b_id, count, inliers, reason))
    return tuple(sorted(out, key=lambda near: (-near.inliers, -near.matches, near.a, near.b)))
