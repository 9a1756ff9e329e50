"""Maps on different floors are never one: which links between maps their labels exclude.

Twin rooms on two floors look the same, and no measurement of a robot on one floor contradicts a link to the
other. People say on which floor a map is; maps without a label are on the floor of those with which they
have most landmarks in common, directly or over others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from mapweave.hybridmap.node import MapId
from mapweave.merge.pose_graph.links import Link

MapPair = tuple[MapId, MapId]


def across_floors(links: Iterable[Link], floors: Mapping[MapId, str]) -> dict[MapPair, str]:
    """Pairs of maps, the smaller first, that are not linked since they are on different floors, and why.

    Without the links between them no component has maps with two labels.

    Args:
        links: verified.
        floors: labels of maps.
    """
    support: Counter[MapPair] = Counter()
    for link in links:
        if not link.within:
            support[link.maps] += link.weight
    group = {map_id: map_id for pair in support for map_id in pair}
    label = {map_id: floors.get(map_id, "") for map_id in group}

    def root(map_id: MapId) -> MapId:
        while group[map_id] != map_id:
            group[map_id] = map_id = group[group[map_id]]
        return map_id

    # As Kruskal's spanning tree, best supported first, but no two labels come into one tree.
    for a, b in sorted(support, key=lambda pair: (-support[pair], pair)):
        first, second = root(a), root(b)
        if not (label[first] and label[second] and label[first] != label[second]):
            group[second] = first
            label[first] = label[first] or label[second]
    excluded = {}
    for a, b in support:
        one, other = label[root(a)], label[root(b)]
        if one != other:
            excluded[a, b] = f"{_where(a, one, floors)} and {_where(b, other, floors)}"
    return excluded


def _where(map_id: MapId, floor: str, floors: Mapping[MapId, str]) -> str:
    derived = "" if map_id in floors else ", by what it has in common with others"
    return f"{map_id} is on floor {floor}{derived}"
