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
    """Finds places that look like one that was recognised. It stands for one merged map."""

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
            index: which nodes look like a view.
            node_of: gives a node by its id.
            merged: where nodes are.
            cache: which nodes look alike; outlives the merged map.
            recognition: when a place counts as recognised.
            regions: when a place counts as being there twice, by its surroundings.
            faint: candidates that look less alike than this share of the best one are left out.
        """
        self._node_of, self._merged, self._cache = node_of, merged, cache
        self._settings, self._faint = recognition, faint
        self._regions = AliasedRegions(index, node_of, merged, cache, regions)

    def prepare(self, most: int) -> int:
        """Find out what at most so many nodes look like before anybody asks, and say how many are left."""
        return self._regions.prepare(most)

    def matches(self, view: View, best: NodeMatch, ranked: Sequence[tuple[NodeId, float]]) -> list[NodeMatch]:
        """Nodes elsewhere, of those that look like a view, that look like the node recognised best."""
        s, found, node = self._settings, [], self._node_of(best.node)
        for other in elsewhere(ranked, best.node, self._faint):
            double = self._node_of(other)
            if node is None or double is None:
                continue
            mapped = between(self._merged, other, best.node)
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
                found.append(alias)
        return found

    def counterpart(self, place: PlaceHypothesis, ranked: Sequence[NodeId]) -> PlaceHypothesis | None:
        """Where the robot may be as well, by what the surroundings of a place look like."""
        best = place.best
        found = self._regions.counterpart(best, ranked)
        if found is None:
            return None
        twice = [pair for pair in best.recognition.pairs.tolist() if pair[1] in found.features]
        recognition = replace(best.recognition, node_from_robot=found.node_from_robot, pairs=np.array(twice))
        seen = NodeMatch(found.node, recognition)
        return PlaceHypothesis([seen], found.node_from_robot, found.features, found.nodes)
