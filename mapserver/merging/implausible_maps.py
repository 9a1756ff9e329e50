"""Implausible maps: what is wrong with each map by itself, and beside the others once they are merged."""

from collections.abc import Container

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.plausibility import (
    contradict_each_other,
    contradict_themselves,
    implausible,
    scattered,
)
from mapweave.merge.pose_graph.merged_map import MergedMap


class ImplausibleMaps:
    """Finds them, and keeps what was found of maps that did not change."""

    refused: dict[MapId, str]
    """Maps of which a change was refused, and why the first one was."""
    disbelieved: dict[MapId, str]
    """Maps of which something said is not believed, and why the first such thing is not."""

    def __init__(self) -> None:
        self._by_itself: dict[MapId, str] = {}
        self._by_views: dict[MapId, str] = {}
        self.refused = {}
        self.disbelieved = {}

    def changed(self, map_id: MapId, hybrid_map: HybridMap) -> None:
        """Look at a map that is new or has changed."""
        self._by_itself[map_id] = implausible(hybrid_map)

    def note_views(self, map_id: MapId, reason: str) -> None:
        """Note what the views of a map say against its own way; empty for nothing."""
        self._by_views[map_id] = reason

    def note_refusal(self, map_id: MapId, reason: str) -> bool:
        """Note that a change of a map was refused; returns whether it is the first, which is kept."""
        first = map_id not in self.refused
        self.refused.setdefault(map_id, reason)
        return first

    def note_disbelief(self, map_id: MapId, reason: str) -> bool:
        """Note that something said of a map is not believed; returns whether it is the first that is."""
        first = map_id not in self.disbelieved
        self.disbelieved.setdefault(map_id, reason)
        return first

    def of(self, merged: MergedMap, pruned: Container[MapId]) -> dict[MapId, str]:
        """The implausible maps of a merged map, in order, with what is wrong in words.

        Args:
            merged: as it was just merged.
            pruned: maps that had more nodes, which newer ones have superseded.
        """
        odd = contradict_each_other(merged) | contradict_themselves(merged)
        for known in (self._by_views, self._by_itself):
            odd |= {which: reason for which, reason in known.items() if reason}
        odd |= scattered(merged.maps, pruned) | self.disbelieved | self.refused
        return {which: odd[which] for which in sorted(odd.keys() & merged.maps.keys())}
