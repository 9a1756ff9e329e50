"""From maps to a merged map, with what each step knows from the last time."""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.limits import MAX_POSITION
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pruned_node import PrunedNodes
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.mapserver.plausibility import fragments
from mapweave.merge.islands import Islands
from mapweave.merge.map_maintenance.landmark_removal import LandmarkRemover
from mapweave.merge.map_maintenance.node_superseding import NodeSuperseder
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.pinned_frames import PinnedFrames
from mapweave.merge.pose_graph.staged_optimization import StagedOptimization
from mapweave.merge.pose_graph.verdicts import Verdicts
from mapweave.merge.settings import MergeSettings


class MergePipeline:
    """The merge, implausible maps last, pinned frames, superseding of nodes and removal of landmarks.

    Attributes:
        islands: merge.
        superseder: knows what is superseded.
    """

    def __init__(
        self, settings: MergeSettings, reaches: ReachabilityCache, pause: Callable[[], None] = lambda: None
    ) -> None:
        """Nothing is merged yet.

        Args:
            settings: how.
            reaches: where from which nodes can be seen.
            pause: see `Islands`.
        """
        self.islands = Islands(settings, pause=pause)
        self._staged = StagedOptimization()
        self._frames = PinnedFrames()
        self.superseder = NodeSuperseder(reaches)
        self._remover = LandmarkRemover()

    def merged(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        constraints: ManualConstraints,
        pins: Sequence[Pin] = (),
        implausible: Callable[[MergedMap], Mapping[MapId, str]] = lambda merged: {},
        pruned: PrunedNodes | None = None,
    ) -> MergedMap:
        """See `Islands.merge`; components are where pins hold them, oldest first.

        Args:
            maps: see `Islands.merge`; likewise verdicts, touched and constraints.
            verdicts: on pairs of their nodes.
            touched: maps that have changed.
            constraints: manual constraints.
            pins: hold frames.
            implausible: gives the implausible maps of the merged map.
            pruned: nodes that newer ones have superseded, and that have left their maps.

        Raises:
            InvalidValue: a node's pose is out of the range of messages.
        """
        merged = self.islands.merge(maps, verdicts, touched, constraints)
        _check_range(merged)
        odd = implausible(merged)
        only_beside_odd = self._only_beside(merged, odd.keys(), maps, verdicts)
        merged = self._frames.moved(self._staged.solved(merged, odd.keys(), only_beside_odd), pins)
        _check_range(merged)
        merged = replace(merged, implausible=odd, pruned=pruned or PrunedNodes())
        unsure = {*merged.implausible, *fragments(maps, merged.pruned.maps)}
        return self._remover.fade(self.superseder.renewed(merged, unsure))

    def _only_beside(
        self,
        merged: MergedMap,
        odd: Set[MapId],
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
    ) -> Set[Pair]:
        """The links between plausible maps that are accepted only since implausible ones bear them out."""
        beside = {which for graph in merged.graphs if graph.maps & odd for which in graph.maps - odd}
        links = {link.key for link in merged.links if beside.issuperset(link.maps)}
        if not links:
            return links
        return links - self.islands.links_among({m: maps[m] for m in maps if m not in odd}, verdicts)


def _check_range(merged: MergedMap) -> None:
    """Raises InvalidValue: a node's pose is out of the range of messages."""
    for graph in merged.graphs:
        # Written so that NaN fails.
        if not (np.abs(graph.means[:, :2]) <= MAX_POSITION).all():
            raise InvalidValue(f"nodes joined with {graph.anchor} lie beyond {MAX_POSITION:g} m")
