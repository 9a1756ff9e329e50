"""Answers between two merges: one merged map with its relocalizer, router and coverage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.active_nodes import ActiveNodes, doubted
from mapweave.mapserver.coverage import SharedCoverage
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap


@dataclass(frozen=True, eq=False)
class Answers:
    """Never changed, only replaced: an answer uses one merged map from beginning to end.

    Attributes:
        merged: the map.
        relocalizer: finds where a view was taken.
        router: finds routes.
        known: what others have mapped.
    """

    merged: MergedMap
    relocalizer: Relocalizer
    router: Router
    known: SharedCoverage

    @classmethod
    def of(cls, merger: Merger, merged: MergedMap, node_of: Callable[[NodeId], Node | None]) -> Answers:
        """Answers from a merged map; newer nodes, which `node_of` returns, have no merged pose yet."""
        set_apart = [node for map_id in merged.set_apart for node in merger.maps[map_id].nodes]
        first = None
        if unsure := doubted(merged):
            sure = ActiveNodes(merger.places, node_of, merged, [*set_apart, *unsure])
            first = Relocalizer(sure, sure.node, merged, alike=merger.alike)
        places = ActiveNodes(merger.places, node_of, merged, set_apart)
        relocalizer = Relocalizer(places, places.node, merged, alike=merger.alike, first=first)
        return cls(merged, relocalizer, Router(merged, reaches=merger.reaches), SharedCoverage(merged))
