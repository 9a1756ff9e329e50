"""Perceptual aliasing: where else a robot may be, because other places look like the recognised one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.alias_cache import AliasCache
from mapweave.mapserver.relocalization.aliased_landmarks import (
    EXPLAINED_PX,
    between,
    carried,
    elsewhere,
    same_place,
    unexplained,
)
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegions, AliasedRegionSettings
from mapweave.mapserver.relocalization.candidates import Retrieval
from mapweave.mapserver.relocalization.place_hypotheses import SLIGHT, NodeMatch, PlaceHypothesis
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.matching import match
from mapweave.registration.recognition import RecognitionSettings


class PerceptualAliasing:
    """Finds places that look like a recognised one. It belongs to one merged map."""

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        cache: AliasCache,
        recognition: RecognitionSettings,
        regions: AliasedRegionSettings,
        faint: float,
    ) -> None:
        """Take what is known.

        Args:
            index: finds candidates of a view.
            node_of: gives a node by its id.
            merged: where nodes are.
            cache: of aliased nodes; outlives the merged map.
            recognition: when a place counts as recognised.
            regions: when a place counts as being there twice, by its surroundings.
            faint: candidates with less than this share of the best one's similarity are left out.
        """
        self._node_of, self._merged, self._cache = node_of, merged, cache
        self._settings, self._faint = recognition, faint
        self._regions = AliasedRegions(index, node_of, merged, cache, regions)

    def prepare(self, most: int) -> int:
        """Evaluate the aliases of at most so many nodes in advance, and return how many are left."""
        return self._regions.prepare(most)

    def matches(self, view: View, best: NodeMatch, ranked: Sequence[tuple[NodeId, float]]) -> list[NodeMatch]:
        """Candidates of a view that are elsewhere and look like the node recognised best."""
        s, aliases, node = self._settings, [], self._node_of(best.node)
        for candidate in elsewhere(ranked, best.node, self._faint):
            double = self._node_of(candidate)
            if node is None or double is None:
                continue
            mapped = between(self._merged, candidate, best.node)
            if mapped is not None:
                pairs = match(double.landmarks.codes, node.landmarks.codes, s.matching)
                left = unexplained(double, pairs, node.landmarks.pixels, node.camera, mapped, EXPLAINED_PX)
                if left < s.least_inliers:
                    continue
            likeness = self._cache.compare(double, node)
            if likeness is None or (mapped is not None and same_place(mapped, likeness.node_from_robot.mean)):
                continue
            alias = carried(double, likeness, best, view, s.matching, EXPLAINED_PX)
            if alias.recognition.inliers >= SLIGHT * best.recognition.inliers:
                aliases.append(alias)
        return aliases

    def counterpart(self, place: PlaceHypothesis, ranked: Sequence[NodeId]) -> PlaceHypothesis | None:
        """Other poses where the robot may be, by aliased surroundings of a place."""
        best = place.best
        region = self._regions.counterpart(best, ranked)
        if region is None:
            return None
        twice = [pair for pair in best.recognition.pairs.tolist() if pair[1] in region.features]
        recognition = replace(best.recognition, node_from_robot=region.node_from_robot, pairs=np.array(twice))
        match = NodeMatch(region.node, recognition)
        return PlaceHypothesis([match], region.node_from_robot, region.features, region.nodes)
