"""Partings: what has become one map, or is no longer one, from one merge to the next."""

from collections import Counter
from collections.abc import Collection, Iterable

import networkx as nx

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import decided, reason_of
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap

MOST_NAMED = 4
"""Maps that are named one by one."""


def joined_maps(merged: MergedMap) -> list[frozenset[MapId]]:
    """Sets of maps that are one, of single ones too, by their smallest; maps without nodes are in none."""
    graph: nx.Graph = nx.Graph()
    for component in merged.components:
        inside = sorted({node.map for node in component})
        graph.add_nodes_from(inside)
        graph.add_edges_from((inside[0], map_id) for map_id in inside[1:])
    return sorted((frozenset(part) for part in nx.connected_components(graph)), key=min)


def partings(
    before: Iterable[frozenset[MapId]], links: Collection[Link] | None, after: MergedMap
) -> tuple[str, ...]:
    """What is no longer one map, with the reason.

    Args:
        before: sets of maps that were one.
        links: that joined them; None if these are not known any more.
        after: the merge now.

    Returns:
        For example `r1.1 and r3.1 are no longer one map: 8 links refused (r1 would have seen ...)`.
    """
    part_of = {map_id: part for part in joined_maps(after) for map_id in part}
    out: list[str] = []
    for whole in before:
        met = {part_of[map_id] for map_id in whole if map_id in part_of}
        parts = sorted({part & whole for part in met}, key=lambda p: (-len(p), min(p)))
        for part in parts[1:]:
            lost = _refused_now(part, whole, after) if links is None else _lost(part, links, after)
            out.append(f"{_briefly(parts[0])} and {_briefly(part)} are no longer one map: {lost}")
    return tuple(out)


def joinings(before: Iterable[frozenset[MapId]], after: MergedMap) -> tuple[str, ...]:
    """What has become one map.

    Returns:
        For example `r1.1 and r3.1 are one map now, by 8 links`.
    """
    part_of = {map_id: part for part in before for map_id in part}
    wholes = []
    for whole in joined_maps(after):
        groups = {part_of.get(map_id, frozenset([map_id])) & whole for map_id in whole}
        # The largest first, then by name: the order of arrival depends on the network.
        wholes.append(sorted(groups, key=lambda part: (-len(part), min(part))))
    seat = {
        map_id: (k, n) for k, parts in enumerate(wholes) for n, part in enumerate(parts) for map_id in part
    }
    ties: dict[tuple[int, int], Counter[int]] = {}
    for link in after.links:
        a, b = seat[link.a.map], seat[link.b.map]
        if a != b:
            ties.setdefault(a, Counter())[b[1]] += 1
            ties.setdefault(b, Counter())[a[1]] += 1
    out = []
    for k, parts in enumerate(wholes):
        # Those first that a link joins to what is one already; so each link is counted once.
        joined, counts, left = parts[0], Counter(ties.get((k, 0))), list(range(1, len(parts)))
        while left:
            n = next((n for n in left if counts[n]), left[0])
            left.remove(n)
            by = counted(counts[n], "link") if counts[n] else "way of others"
            out.append(f"{_briefly(joined)} and {_briefly(parts[n])} are one map now, by {by}")
            joined, counts = joined | parts[n], counts + ties.get((k, n), Counter())
    return tuple(out)


def _briefly(maps: frozenset[MapId]) -> str:
    """A component in short, for example `r0.1+r2.1`: with `and` the sides would be ambiguous."""
    named = "+".join(str(map_id) for map_id in sorted(maps))
    return named if len(maps) <= MOST_NAMED else f"{len(maps)} maps with {min(maps)}"


def _refused_now(part: frozenset[MapId], whole: frozenset[MapId], after: MergedMap) -> str:
    """Reasons between a part and the rest, when the lost links are not known any more."""
    reasons: Counter[str] = Counter()
    for r in after.refused:
        ends = {r.a.map in part, r.b.map in part}
        if r.link is not None and r.edge is None and len(ends) == 2 and {r.a.map, r.b.map} <= whole:
            reasons[r.reason] += 1
    return "; ".join(_refused(reasons)) or "no link joins them any more"


def _lost(part: frozenset[MapId], links: Collection[Link], after: MergedMap) -> str:
    """What has become of the links that held a part."""
    held = [link for link in links if (link.a.map in part) != (link.b.map in part)]
    pairs = {link.pair for link in held}
    reasons = Counter(r.reason for r in after.refused if r.pair in pairs and r.edge is None)
    away = [next(filter(None, map(after.constraints.retires, pair)), None) for pair in pairs]
    removed = [
        pair
        for pair, which in zip(pairs, away, strict=True)
        if which is None and (pair[0] not in after.poses or pair[1] not in after.poses)
    ]
    reasons_in_words = _refused(reasons)
    whys = Counter(reason_of(constraint) for constraint in away if constraint is not None)
    reasons_in_words += [f"{counted(count, 'link')} gone, since {why}" for why, count in sorted(whys.items())]
    if removed:
        reasons_in_words.append(f"{counted(len(removed), 'link')} gone with a node")
    seen = {r.pair for r in after.refused} | {*removed}
    seen |= {pair for pair, which in zip(pairs, away, strict=True) if which is not None}
    by_hand = [after.constraints.taken_back(*pair) for pair in pairs - seen]
    backs = Counter(decided(constraint) for constraint in by_hand if constraint is not None)
    reasons_in_words += [
        f"{counted(count, 'link')} by hand taken back {how}" for how, count in sorted(backs.items())
    ]
    left = len(pairs) - sum(reasons.values()) - len(removed) - whys.total() - backs.total()
    if left > 0:
        reasons_in_words.append(f"{counted(left, 'link')} no longer among the most similar pairs")
    return "; ".join(reasons_in_words) or "a map has fallen into pieces"


def _refused(reasons: Counter[str]) -> list[str]:
    return [f"{counted(count, 'link')} refused ({reason})" for reason, count in reasons.most_common(3)]
