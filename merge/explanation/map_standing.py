"""How each map stands in the merge, in a few words: for lists of robots, where an explanation is too long."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import reason_of
from mapweave.merge.explanation.component_changes import joined_maps
from mapweave.merge.explanation.twin_maps import are_twins, twin_words
from mapweave.merge.pose_graph.links import RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap

UNLIKE = "none of its nodes looks like one of another map"


class MapStanding(NamedTuple):
    """How one map stands in the merge.

    Attributes:
        newest: its newest node; None without nodes.
        links: with other maps.
        apart: why it is one with no other map; empty if it is, or if there is no other.
    """

    newest: NodeId | None
    links: int
    apart: str


def map_standings(merged: MergedMap) -> dict[MapId, MapStanding]:
    """The standing of every map, those that are set apart included."""
    joined = {map_id for part in joined_maps(merged) if len(part) > 1 for map_id in part}
    links: Counter[MapId] = Counter()
    for link in merged.links:
        if not link.within:
            links.update((link.a.map, link.b.map))
    refused: dict[MapId, Counter[str]] = {}
    between: dict[tuple[MapId, MapId], list[RefusedLink]] = {}
    alike: Counter[MapId] = Counter()
    for pair in merged.refused:
        if pair.edge is not None or pair.a.map == pair.b.map:
            continue
        if pair.link is not None:
            between.setdefault(_ordered(pair.a.map, pair.b.map), []).append(pair)
        for map_id in (pair.a.map, pair.b.map):
            if pair.link is None:
                alike[map_id] += 1
            else:
                refused.setdefault(map_id, Counter())[pair.reason] += 1
    twin = _twins(merged, between)
    accusations, out = merged.accusations(), dict[MapId, MapStanding]()
    for map_id in sorted({*merged.maps, *merged.set_apart}):
        nodes = merged.maps[map_id].nodes if map_id in merged.maps else ()
        apart = ""
        if map_id not in joined and len(merged.maps) + len(merged.set_apart) > 1:
            constraint = merged.constraints.retired.get(map_id)
            apart = (
                (reason_of(constraint) if constraint is not None else "")
                or accusations.get(map_id, "")
                or "; ".join(filter(None, (twin.get(map_id), _refused(refused.get(map_id, Counter())))))
                or (only_similar(alike[map_id]) if alike[map_id] else UNLIKE)
            )
        out[map_id] = MapStanding(max(nodes, default=None), links[map_id], apart)
    return out


def all_refused(count: int) -> str:
    """That this many links were found, and not one of them kept; the reasons are to follow."""
    return "1 link was found and refused" if count == 1 else f"{count} links were found and all refused"


def only_similar(count: int) -> str:
    """That this many pairs of nodes are as near to a link as there is any."""
    many = "1 pair of nodes looks" if count == 1 else f"{count} pairs of nodes look"
    return f"{many} similar and no two have a common pose"


def _ordered(one: MapId, other: MapId) -> tuple[MapId, MapId]:
    return min(one, other), max(one, other)


def _twins(
    merged: MergedMap, between: Mapping[tuple[MapId, MapId], Sequence[RefusedLink]]
) -> dict[MapId, str]:
    """What is said of each map that shows the same places as another one; of several the most alike."""
    out: dict[MapId, str] = {}
    for pair, links in sorted(between.items(), key=lambda item: (-len(item[1]), item[0])):
        if are_twins(links) and not merged.joined(*pair):
            for map_id in pair:
                out.setdefault(map_id, twin_words(*pair))
    return out


def _refused(reasons: Counter[str]) -> str:
    if not reasons:
        return ""
    (reason, count), total = reasons.most_common(1)[0], reasons.total()
    return f"{all_refused(total)}: {reason}{'' if count == total else f' ({count} of them)'}"
