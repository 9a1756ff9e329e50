"""What questions are answered from between two merges: one merged map, and who reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hybridmap.node import Node, NodeId
from mapserver.known import Known
from mapserver.living import LivingPlaces
from mapserver.merging.merger import Merger
from mapserver.relocalizing.relocalization import Relocalizer
from mapserver.routes import Router
from merge.graph.merged import MergedMap


@dataclass(frozen=True, eq=False)
class Answers:
    """Never changed, only replaced: whoever answers keeps what it began with, whatever is merged meanwhile.

    Attributes:
        merged: the map.
        relocalizer: says where a view was taken.
        router: says how to get somewhere.
        known: says what others have mapped.
    """

    merged: MergedMap
    relocalizer: Relocalizer
    router: Router
    known: Known

    @classmethod
    def of(cls, merger: Merger, merged: MergedMap, node_of: Callable[[NodeId], Node | None]) -> Answers:
        """Answers from a merged map; nodes that are newer, of which `node_of` knows, lie nowhere yet."""
        set_apart = [node for one in merged.set_apart for node in merger.maps[one].nodes]
        places = LivingPlaces(merger.index, node_of, merged, set_apart)
        relocalizer = Relocalizer(places, places.node, merged, alike=merger.alike)
        return cls(merged, relocalizer, Router(merged, reaches=merger.reaches), Known(merged))
