"""Places the nodes of implausible maps last: what such a map measured moves no nodes of other maps.

It is joined where its links support it, since an honest robot may have a clock that runs backwards. But the
others are where they are without it: they are solved first, and then held.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.ids import MapId
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.merged_map import MergedMap, Poses
from mapweave.merge.pose_graph.optimization import optimized
from mapweave.merge.pose_graph.solved_graph import PoseGraph


class ImplausibleLast:
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
                    known = graph, odd, _placed_last(graph, odd)
                kept[id(graph)] = known
                graph = known[2]
            graphs.append(graph)
        self._solved = kept
        if not kept:
            return merged
        return replace(merged, graphs=tuple(graphs), poses=Poses(graphs))


def _placed_last(graph: PoseGraph, odd: Set[MapId]) -> PoseGraph:
    """A component in which some maps move no others; as it is if they alone join the others."""
    assert isinstance(graph, Component), "the solver's"
    is_odd = np.array([node.map in odd for node in graph.nodes])
    sound = np.flatnonzero(~is_odd)
    factors = graph.factors
    between = factors.take(~is_odd[factors.a] & ~is_odd[factors.b])
    if len(between.around(sound[:1], len(graph.nodes), len(graph.nodes))) < len(sound):
        return graph
    anchor = graph.rows[graph.anchor]
    held = sound[:1] if is_odd[anchor] else np.array([anchor])
    means = optimized(between, graph.means, sound, held)
    means = optimized(factors, means, np.flatnonzero(is_odd), sound[:0])
    return Component(graph.anchor, graph.nodes, means, factors, graph.unsettled)
