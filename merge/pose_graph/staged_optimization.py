"""Optimises in two stages: implausible maps behind the others, so that what they measured bears on no others.

Such a map is joined where its links support it, since an honest robot may have a clock that runs backwards.
But the others are where they are without it, and as certain: they are solved first, and then held.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId
from mapweave.merge.pose_graph.component import Component, pieces
from mapweave.merge.pose_graph.factors import Factors, Rows
from mapweave.merge.pose_graph.merged_map import MergedMap, Poses
from mapweave.merge.pose_graph.optimization import optimized
from mapweave.merge.pose_graph.solved_graph import PoseGraph


class StagedOptimization:
    """Keeps what it has solved: a component that did not change is the same object the next time."""

    def __init__(self) -> None:
        """Nothing is solved yet."""
        self._solved: dict[int, tuple[PoseGraph, Set[MapId], PoseGraph]] = {}

    def solved(self, merged: MergedMap, implausible: Set[MapId]) -> MergedMap:
        """A merged map whose plausible maps are where they are without the others.

        Args:
            merged: as all measurements together have it.
            implausible: maps of it.
        """
        kept = {}
        graphs = []
        for graph in merged.graphs:
            odd = graph.maps & implausible
            if odd and odd < graph.maps:
                known = self._solved.get(id(graph))
                if known is None or known[1] != odd:
                    known = graph, odd, _in_two_stages(graph, odd)
                kept[id(graph)] = known
                graph = known[2]
            graphs.append(graph)
        self._solved = kept
        if not kept:
            return merged
        return replace(merged, graphs=tuple(graphs), poses=Poses(graphs))


def _in_two_stages(graph: PoseGraph, odd: Set[MapId]) -> PoseGraph:
    """A component in which some maps move no others; as it is if they alone join the others."""
    assert isinstance(graph, Component), "the solver's"
    is_odd = np.array([node.map in odd for node in graph.nodes])
    sound, factors = np.flatnonzero(~is_odd), graph.factors
    ends_odd = is_odd[factors.a].astype(np.int64) + is_odd[factors.b]
    between = factors.take(ends_odd == 0)
    if len(np.unique(pieces(between, len(graph.nodes))[sound])) > 1:
        return graph
    anchor = graph.rows[graph.anchor]
    held = sound[:1] if is_odd[anchor] else np.array([anchor])
    means = optimized(between, graph.means, sound, held)
    means = optimized(factors, means, np.flatnonzero(is_odd), sound[:0])
    attached = Factors.together(
        [between, factors.take(ends_odd == 2), _attachments(factors, is_odd, ends_odd)]
    )
    return Component(graph.anchor, graph.nodes, means, attached, graph.unsettled)


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
