"""Floors: which links between maps their labels exclude, and on which floor a part of the merged map is.

Twin rooms on two floors look the same, and no measurement of a robot on one floor contradicts a link to the
other. People say on which floor a map is; maps without a label are on the floor of those with which they
have most landmarks in common, directly or over others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.node import EdgeKind

if TYPE_CHECKING:
    # Programs that only name floors need none of the merge's libraries.
    import networkx as nx

    from mapweave.merge.pose_graph.links import Link
    from mapweave.merge.pose_graph.merged_map import MergedMap
    from mapweave.merge.pose_graph.verdicts import MapPair

MOST_NAMED = 4
"""Of the maps of a part that comes apart, so many are named."""


def labels_of(merged: MergedMap, floors: Mapping[MapId, str], component: int | None) -> tuple[str, ...]:
    """The labels of a component's maps, in order; none of a component that is not there."""
    if not floors or component is None or not 0 <= component < len(merged.graphs):
        return ()
    maps = {MapId(*map_id) for map_id in merged.graphs[component].maps}
    return tuple(sorted({floors[map_id] for map_id in maps if map_id in floors}))


def floor_of(merged: MergedMap, floors: Mapping[MapId, str], node: NodeId) -> str:
    """The label of the floor on which a node is: of its map, else of its component; empty if unknown."""
    return floors.get(node.map) or " and ".join(labels_of(merged, floors, merged.component_of(node)))


def maps_elsewhere(merged: MergedMap, floors: Mapping[MapId, str], node: NodeId) -> frozenset[MapId]:
    """Maps on another floor than a node: their own label says so, or that of their component."""
    here = floor_of(merged, floors, node)
    if not here:
        return frozenset()
    elsewhere = {which for which, label in floors.items() if label != here}
    for number, graph in enumerate(merged.graphs):
        labels = labels_of(merged, floors, number)
        if labels and here not in labels:
            elsewhere.update(MapId(*map_id) for map_id in graph.maps)
    return frozenset(elsewhere)


def held_together(
    merged: MergedMap, constraints: ManualConstraints, floors: Mapping[MapId, str], labelled: MapId
) -> str:
    """Why a map cannot be on the floor that its label says; empty if it may be.

    Links that robots have found fall if labels contradict them: twin rooms look the same. A link by hand, and
    a drive from one map to another, do not: they would leave two floors in one component.

    Args:
        merged: the map.
        constraints: with the links by hand.
        floors: labels of maps, the new one among them.
        labelled: the map with the new label.
    """
    import networkx as nx

    ties: nx.Graph = nx.Graph()
    ties.add_node(labelled)
    for a, b in constraints.links:
        ties.add_edge(a.map, b.map, words=f"{a} and {b} are linked by hand")
    for hybrid_map in merged.maps.values():
        for edge in hybrid_map.edges.values():
            if edge.a.map != edge.b.map and edge.kind is EdgeKind.DRIVEN:
                words = f"a robot has driven between {edge.a} and {edge.b}"
                ties.add_edge(edge.a.map, edge.b.map, words=words)
    for other, way in sorted(nx.single_source_shortest_path(ties, labelled).items()):
        if floors.get(other, floors[labelled]) != floors[labelled]:
            steps = "; ".join(ties.edges[pair]["words"] for pair in pairwise(way))
            return f"map {other} is on floor {floors[other]}, and {steps}"
    return ""


class FloorParting(NamedTuple):
    """What labels of floors do to the links of a merged map.

    Attributes:
        links: so many fall that hold without the new label.
        parts: for each component that falls apart the maps of its parts, those of the new label first.
    """

    links: int
    parts: tuple[tuple[tuple[MapId, ...], ...], ...]

    @property
    def words(self) -> str:
        """The floor in one phrase; empty if no link falls."""
        if not self.links:
            return ""
        fall = f"{counted(self.links, 'link')} {'falls' if self.links == 1 else 'fall'}"
        return " and ".join((fall, *map(_parting_words, self.parts)))


def parted_by(merged: MergedMap, floors: Mapping[MapId, str], node: NodeId, label: str) -> FloorParting:
    """What falls when the map of a node gets a label, also where others have theirs only by inference.

    Links by hand do not fall, so they hold their maps together.

    Args:
        merged: the map.
        floors: labels of maps without the new one.
        node: of the map.
        label: the new one.
    """
    import networkx as nx

    by_hand = merged.constraints.links
    links = [link for link in merged.links if not link.within and link.pair not in by_hand]
    before, after = (across_floors(links, some) for some in (floors, {**floors, node.map: label}))
    ties = [(a.map, b.map) for a, b in by_hand]
    parts = []
    for graph in merged.graphs:
        inside = {MapId(*map_id) for map_id in graph.maps}
        held = []
        for apart in (before, after):
            joined: nx.Graph = nx.Graph()
            joined.add_nodes_from(inside)
            joined.add_edges_from(link.maps for link in links if link.maps not in apart)
            joined.add_edges_from(ties)
            groups = nx.connected_components(joined.subgraph(inside))
            held.append(
                sorted((tuple(sorted(group)) for group in groups), key=lambda g: (node.map not in g, g))
            )
        if len(held[1]) > len(held[0]):
            parts.append(tuple(held[1]))
    fallen = sum(link.maps in after and link.maps not in before for link in links)
    return FloorParting(fallen, tuple(parts))


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


def _parting_words(parts: Sequence[Sequence[MapId]]) -> str:
    names = [_some(part) for part in parts]
    return f"{names[0]} {'parts' if len(parts[0]) == 1 else 'part'} from {' and from '.join(names[1:])}"


def _some(maps: Sequence[MapId]) -> str:
    """Names of maps, of many the first."""
    named = [str(which) for which in maps[:MOST_NAMED]]
    if len(maps) > MOST_NAMED:
        named.append(f"{len(maps) - MOST_NAMED} more")
    return " and ".join(filter(None, (", ".join(named[:-1]), named[-1])))


def _where(map_id: MapId, floor: str, floors: Mapping[MapId, str]) -> str:
    derived = "" if map_id in floors else ", by what it has in common with others"
    return f"{map_id} is on floor {floor}{derived}"
