"""Apply manual constraints: what is excluded takes no part in the merge; refusals say who, when and why."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints, reason_of
from mapweave.merge.floors import across_floors
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse, refuse_edge
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.retired_nodes import without_nodes

BY_HAND = "by_hand"
"""Name among the evidence of a link that a person has made."""


@dataclass(frozen=True, eq=False)
class AppliedConstraints:
    """What is left to merge.

    Attributes:
        maps: without what is excluded; maps with none of this are the very same objects.
        links: without those that are excluded.
        certain: links by hand.
        refused: what was taken away, with reasons.
        whole: the maps as they came.
        constraints: manual constraints, in force or not, with the nodes that they retire.
    """

    maps: Mapping[MapId, HybridMap]
    links: tuple[Link, ...]
    certain: tuple[Link, ...]
    refused: tuple[RefusedLink, ...]
    whole: Mapping[MapId, HybridMap]
    constraints: ManualConstraints

    def completed(self, merged: MergedMap) -> MergedMap:
        """The merge of the rest, with the original maps, so that a constraint can be withdrawn.

        Args:
            merged: the merge of `maps`, `links` and `refused`.
        """
        return replace(merged, maps=dict(sorted(self.whole.items())), constraints=self.constraints)


@dataclass(frozen=True, eq=False)
class CutMaps:
    """Maps without what constraints exclude, made once: later merges know a map by its identity.

    Attributes:
        made: by map: the whole map, what is excluded of it, and the map that is left.
    """

    made: dict[MapId, tuple[HybridMap, frozenset[NodeId], frozenset[EdgeId], HybridMap]] = field(
        default_factory=dict
    )

    def without(self, whole: HybridMap, nodes: frozenset[NodeId], edges: frozenset[EdgeId]) -> HybridMap:
        """A map without some nodes and edges; at least one."""
        which = min(nodes or edges).map
        known = self.made.get(which)
        if known is None or known[0] is not whole or known[1:3] != (nodes, edges):
            left = without_nodes(whole, nodes) if nodes else whole
            if edges:
                left = HybridMap(
                    change
                    for change in left.contents()
                    if not (isinstance(change, EdgePut) and change.edge.id in edges)
                )
            known = self.made[which] = whole, nodes, edges, left
        return known[3]


@lru_cache(maxsize=4096)
def link_by_hand(linked: Linked) -> Link:
    """The link that a person has made: for one constraint always the same object."""
    shared = np.array(linked.shared, np.int64).reshape(-1, 2)
    return Link(linked.a, linked.b, linked.a_from_b, shared, {**dict(linked.evidence), BY_HAND: 1.0})


def apply_constraints(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    constraints: ManualConstraints,
    cut_maps: CutMaps | None = None,
) -> AppliedConstraints:
    """Remove what is excluded: retired maps and nodes, links, and a robot's own loop closures.

    Links between maps on different floors are removed, too (mapweave.merge.floors); links by hand are not.

    Drives and turns that a robot measured while it mapped are kept, also across retired nodes (see
    mapweave.merge.retired_nodes). Links by hand take the place of what was verified of their nodes.

    Args:
        maps: by id; they are not changed.
        links: verified.
        constraints: manual constraints, with the nodes that they retire.
        cut_maps: of merges before; it is filled.
    """
    links = tuple(links)
    apart = across_floors(links, constraints.floors) if constraints.floors else {}
    if apart:
        kept = tuple(link for link in links if link.maps not in apart)
        elsewhere = tuple(refuse(link, apart[link.maps]) for link in links if link.maps in apart)
        rest = apply_constraints(maps, kept, constraints.with_floors({}), cut_maps)
        return replace(rest, refused=(*rest.refused, *elsewhere), constraints=constraints)
    if not constraints.in_force:
        return AppliedConstraints(maps, links, (), (), maps, constraints)
    cut_maps = cut_maps or CutMaps()
    by_hand = {
        pair: _with_landmarks(link_by_hand(linked), maps)
        for pair, linked in constraints.links.items()
        if all(node.map in maps and node in maps[node.map].nodes for node in pair)
    }
    left_links: list[Link] = []
    refused: list[RefusedLink] = []
    for link in links:
        constraint = constraints.against(*link.pair)
        if constraint is not None:
            refused.append(refuse(link, reason_of(constraint)))
        elif link.key not in by_hand:
            left_links.append(link)
    left = {map_id: hybrid_map for map_id, hybrid_map in maps.items() if map_id not in constraints.retired}
    nodes_of: dict[MapId, set[NodeId]] = {}
    for node in constraints.nodes:
        nodes_of.setdefault(node.map, set()).add(node)
    for map_id, hybrid_map in tuple(left.items()):
        nodes = frozenset(nodes_of.get(map_id, ()))
        out = [
            (edge, constraint)
            for edge in hybrid_map.edges.values()
            if edge.kind in CLAIMS and (constraint := constraints.against(edge.a, edge.b)) is not None
        ]
        refused += [refuse_edge(edge, reason_of(constraint)) for edge, constraint in out]
        edges = frozenset(edge.id for edge, _ in out)
        if nodes or edges:
            left[map_id] = cut_maps.without(hybrid_map, nodes, edges)
    return AppliedConstraints(
        left, tuple(left_links), tuple(by_hand.values()), tuple(refused), maps, constraints
    )


@lru_cache(maxsize=4096)
def _without_landmarks(link: Link) -> Link:
    return replace(link, shared=np.zeros((0, 2), np.int64))


def _with_landmarks(link: Link, maps: Mapping[MapId, HybridMap]) -> Link:
    """A link by hand without its landmarks, where a node no longer has as many."""
    counts = [len(maps[node.map].nodes[node].landmarks) for node in link.pair]
    return link if (link.shared < counts).all() else _without_landmarks(link)
