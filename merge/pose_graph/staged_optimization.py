"""Optimises in two stages: implausible maps behind the others, so that what they measured bears on no others.

Such a map is joined where its links support it, since an honest robot may have a clock that runs backwards.
But the others are where they are without it, as certain, and in the same components: they are solved first,
and then held. Where it alone would join others it stays with those to which most links tie it.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component import Component, pieces
from mapweave.merge.pose_graph.factors import Factors, Rows
from mapweave.merge.pose_graph.links import RefusedLink, refuse, refuse_edge
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.optimization import optimized
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.registration.pose_arrays import compose_poses, inverse_poses

ALONE = "is implausible, and what it alone would join is not joined"
"""Reason of a refusal, after the name of the map."""
BORNE_OUT = "only implausible maps bear it out"
"""Reason of a refusal of a link between others."""


class Staged(NamedTuple):
    """What has become of a component in which some maps are implausible.

    Attributes:
        before: the component.
        odd: these maps.
        unsupported: nodes of it between which only these maps bear a link out.
        graphs: the components that it consists of.
        parted: nodes between which a link does not hold.
    """

    before: PoseGraph
    odd: Set[MapId]
    unsupported: Set[Pair]
    graphs: Sequence[PoseGraph]
    parted: Set[Pair]


class StagedOptimization:
    """Keeps what it has solved: a component that did not change is the same object the next time."""

    def __init__(self) -> None:
        self._solved: dict[int, Staged] = {}

    def solved(
        self, merged: MergedMap, implausible: Set[MapId], unsupported: Set[Pair] = frozenset()
    ) -> MergedMap:
        """A merged map whose plausible maps are where they are without the others, and joined as without.

        Args:
            merged: as all measurements together have it.
            implausible: maps of it. Where one of them joins others by a link by hand, it does.
            unsupported: nodes of other maps between which a link was accepted that is not without these.
        """
        by_hand = {(min(pair), max(pair)) for pair in merged.constraints.links}
        kept: dict[int, Staged] = {}
        for graph in merged.graphs:
            odd = graph.maps & implausible
            if odd and odd < graph.maps:
                known = self._solved.get(id(graph))
                alone = {pair for pair in unsupported if pair[0] in graph.rows}
                same = known is not None and (known.odd, known.unsupported) == (odd, alone)
                if known is None or not same or known.parted & by_hand:
                    known = _in_two_stages(graph, odd, alone, merged.maps, by_hand)
                kept[id(graph)] = known
        self._solved = kept
        if not kept:
            return merged
        graphs = [one for g in merged.graphs for one in (kept[id(g)].graphs if id(g) in kept else (g,))]
        parted = set[Pair]().union(*(known.parted for known in kept.values()))
        if not parted:
            return replace(merged, graphs=tuple(graphs), poses=NodePoses(graphs))
        graphs.sort(key=lambda graph: (-len(graph.nodes), graph.anchor))
        refused = sorted(
            (*merged.refused, *_refused(merged, implausible, parted, NodePoses(graphs))),
            key=lambda one: one.pair,
        )
        return replace(
            merged,
            links=tuple(link for link in merged.links if link.key not in parted),
            refused=tuple(refused),
            components=tuple(frozenset(graph.nodes) for graph in graphs),
            poses=NodePoses(graphs),
            graphs=tuple(graphs),
        )


def _refused(
    merged: MergedMap, odd: Set[MapId], parted: Set[Pair], poses: NodePoses
) -> Iterator[RefusedLink]:
    """The links between what is not joined, and the drives."""
    for link in merged.links:
        if link.key in parted:
            which = next((end.map for end in link.key if end.map in odd), None)
            yield refuse(link, BORNE_OUT if which is None else f"map {which} {ALONE}")
    before = {refusal.edge for refusal in merged.refused}
    for hybrid_map in merged.maps.values():
        for edge in hybrid_map.edges.values():
            if not edge.within and edge.id not in before and poses.number(edge.a) != poses.number(edge.b):
                yield refuse_edge(edge, "a drive joins maps that nothing else joins")


def _in_two_stages(
    graph: PoseGraph,
    odd: Set[MapId],
    unsupported: Set[Pair],
    maps: Mapping[MapId, HybridMap],
    by_hand: Collection[Pair],
) -> Staged:
    """A component in which some maps move and join no others; as it is if a person has joined by them."""
    assert isinstance(graph, Component), "the solver's"
    nodes, factors = graph.nodes, graph.factors
    if unsupported:
        ends = zip(factors.a.tolist(), factors.b.tolist(), strict=True)
        stands = [tuple(sorted((nodes[a], nodes[b]))) not in unsupported for a, b in ends]
        factors = factors.take(np.flatnonzero(stands))
    is_odd = np.array([node.map in odd for node in nodes])
    ends_odd = is_odd[factors.a].astype(np.int64) + is_odd[factors.b]
    piece = pieces(factors.take(ends_odd != 1), len(nodes))
    across = np.flatnonzero(ends_odd == 1)
    stays = across[_stays(factors.take(across), piece, is_odd)]
    part = pieces(Factors.together([factors.take(ends_odd != 1), factors.take(stays)]), len(nodes))
    cut = part[factors.a] != part[factors.b]
    rows_parted = np.stack([factors.a[cut], factors.b[cut]], axis=1)
    # Rows are in the order of ids.
    parted = {(nodes[a], nodes[b]) for a, b in np.sort(rows_parted, axis=1).tolist()}
    if not parted.isdisjoint(by_hand):
        return Staged(graph, odd, unsupported, (graph,), set())
    graphs = []
    for label in np.unique(part).tolist():
        rows = np.flatnonzero(part == label)
        row_of = np.zeros(len(nodes), np.int64)
        row_of[rows] = np.arange(len(rows))
        own = factors.take((part[factors.a] == label) & ~cut, row_of)
        some = tuple(nodes[row] for row in rows.tolist())
        means = graph.means[rows]
        if graph.anchor not in some:
            # Its frame is that of the robot of its smallest node, as it is without the implausible map.
            wanted = maps[some[0].map].nodes[some[0]].map_from_robot.mean.vector[None]
            means = compose_poses(compose_poses(wanted, inverse_poses(means[:1])), means)
            means[0] = wanted[0]
        graphs.append(_part_in_two_stages(some, means, own, is_odd[rows], graph.unsettled))
    return Staged(graph, odd, unsupported, graphs, parted | unsupported)


def _stays(across: Factors, piece: Rows, is_odd: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) which measurements tie a piece of odd maps to the one piece of others that it stays with.

    Args:
        across: (N,) measurements between odd maps and others.
        piece: of which connected piece of odd maps, or of others, each node is.
        is_odd: of each node.
    """
    at_odd = is_odd[across.a]
    own = piece[np.where(at_odd, across.a, across.b)]
    other = piece[np.where(at_odd, across.b, across.a)]
    pairs, which, counts = np.unique(np.stack([own, other]), axis=1, return_inverse=True, return_counts=True)
    sizes = np.bincount(piece)
    # Most links, then most nodes, then the smallest id.
    order = np.lexsort([pairs[1], -sizes[pairs[1]], -counts, pairs[0]])
    best = order[np.unique(pairs[0][order], return_index=True)[1]]
    out: NDArray[np.bool_] = np.isin(which.ravel(), best)
    return out


def _part_in_two_stages(
    nodes: Sequence[NodeId], means: Array, factors: Factors, is_odd: NDArray[np.bool_], unsettled: int
) -> Component:
    """A component whose others hang together without the odd maps; its first node is held."""
    ends_odd = is_odd[factors.a].astype(np.int64) + is_odd[factors.b]
    between = factors.take(ends_odd == 0)
    sound = np.flatnonzero(~is_odd)
    held = sound[:1] if is_odd[0] else np.zeros(1, np.int64)
    means = optimized(between, means, sound, held)
    means = optimized(factors, means, np.flatnonzero(is_odd), sound[:0])
    attached = Factors.together(
        [between, factors.take(ends_odd == 2), _attachments(factors, is_odd, ends_odd)]
    )
    return Component(nodes[0], tuple(nodes), means, attached, unsettled)


def _attachments(factors: Factors, is_odd: NDArray[np.bool_], ends_odd: Rows) -> Factors:
    """The surest measurement from each piece of the odd maps to the others.

    One closes no loop: covariances of the others are what they are without the odd maps, and those of the
    odd maps rather too large.
    """
    piece = pieces(factors.take(ends_odd == 2), len(is_odd))
    across = np.flatnonzero(ends_odd == 1)
    own = piece[np.where(is_odd[factors.a[across]], factors.a[across], factors.b[across])]
    unsure = np.trace(np.linalg.inv(factors.weights[across]), axis1=1, axis2=2)
    order = np.lexsort([unsure, own])
    return factors.take(across[order[np.unique(own[order], return_index=True)[1]]])
