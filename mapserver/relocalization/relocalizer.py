"""Tells a lost robot where it is: look up, recognise, compare the places with each other, answer honestly.

An answer is FOUND only if every place that explains the view about as well is the same place. Whether two
places are the same is asked of the merged map: the poses that they give must agree within what the map and
the recognitions are certain of.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.mapserver.relocalization.alias_cache import AliasCache, Retrieval
from mapweave.mapserver.relocalization.aliased_landmarks import (
    between,
    carried,
    elsewhere,
    same_place,
    unexplained,
)
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegions, AliasedRegionSettings
from mapweave.mapserver.relocalization.place_hypotheses import NodeMatch, PlaceHypothesis, is_lonely
from mapweave.mapserver.relocalization.verdict import ALONE, SLIGHT, HypothesisSelector, unknown
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.matching import match
from mapweave.registration.pose_refinement import refine_pose
from mapweave.registration.recognition import Recognition, RecognitionSettings, Refusal, examine_matches


@dataclass(frozen=True)
class RelocalizationSettings:
    """How a view is answered.

    Attributes:
        recognition: when a view counts as recognised.
        regions: when a place counts as being there twice, by its surroundings.
        faint: a node that looks so much less like the view than one that was recognised is not looked at.
    """

    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)
    regions: AliasedRegionSettings = field(default_factory=AliasedRegionSettings)
    faint: float = 0.25


MOST_COMPARED = 16
"""Nodes that are compared with the view."""
EXPLAINED_PX = 12.0
"""A match nearer than this to where a pose found elsewhere expects it speaks for that."""


class Relocalizer:
    """Answers where views were taken. It stands for one merged map; make another for the next."""

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        settings: RelocalizationSettings | None = None,
        alike: AliasCache | None = None,
    ) -> None:
        """Take what is known.

        Args:
            index: which nodes look like a view; may know nodes that the merged map does not know yet.
            node_of: gives a node by its id, for example `Merger.node`.
            merged: where nodes are.
            settings: how.
            alike: which nodes look alike; outlives the merged map, so that it is found out once.
        """
        self._index = index
        self._node_of = node_of
        self._merged = merged
        self._settings = settings or RelocalizationSettings()
        self.alike = alike or AliasCache(self._settings.recognition)
        self.judge = HypothesisSelector(merged)
        self._regions = AliasedRegions(index, node_of, merged, self.alike, self._settings.regions)

    def answer(self, view: View) -> RelocalizeAnswer:
        """Say where a view was taken, or that it is not known, with the reason in words."""
        s = self._settings
        if len(view) < s.recognition.least_inliers:
            return unknown(f"the view has {len(view)} features; {s.recognition.least_inliers} are needed")
        ranked = self._index.query(view, MOST_COMPARED)
        if not ranked:
            return unknown("no node of any map has features like these")
        sightings, refusals = self.look(view, ranked)
        if sightings:
            return self.conclude(view, sightings, ranked)
        return unknown(_best_refusal(refusals))

    def look(
        self, view: View, ranked: Sequence[tuple[NodeId, float]]
    ) -> tuple[list[NodeMatch], list[tuple[NodeId, Refusal]]]:
        """Compare a view with nodes, as far as it can matter.

        Args:
            view: the image's features.
            ranked: nodes with how much they look like it, best first.

        Returns:
            Those that were recognised, and why others were not.
        """
        s = self._settings
        sightings: list[NodeMatch] = []
        refusals: list[tuple[NodeId, Refusal]] = []
        best_score = 0.0
        for node_id, score in ranked:
            sure = any(one.recognition.inliers >= ALONE for one in sightings)
            node = self._node_of(node_id)
            if node is None or (sure and score < s.faint * best_score):
                continue
            pairs = match(node.landmarks.codes, view.codes, s.recognition.matching)
            if sure and not self._may_differ(node, pairs, view, sightings):
                continue
            seed = zlib.crc32(view.codes.tobytes(), zlib.crc32(str(node_id).encode()))
            verdict = examine_matches(node, view, pairs, s.recognition, np.random.default_rng(seed))
            if isinstance(verdict, Recognition):
                lonely = is_lonely(node, view, verdict)
                sightings.append(NodeMatch(node_id, verdict, lonely=lonely))
                best_score = max(best_score, score)
            else:
                refusals.append((node_id, verdict))
        return sightings, refusals

    def conclude(
        self, view: View, sightings: Sequence[NodeMatch], ranked: Sequence[tuple[NodeId, float]]
    ) -> RelocalizeAnswer:
        """Say what follows from the nodes that were recognised.

        Args:
            view: the image's features.
            sightings: these.
            ranked: nodes with how much they look like the view, best first; those that look like the one that
                was recognised best are thought of too.
        """
        if not sightings:
            return unknown("no node was recognised")
        best, *others = sorted(sightings, key=lambda one: (-one.recognition.inliers, one.node))
        best = self._closer(view, best)
        places = self.judge.places([best, *others, *self.doubled(view, best, ranked)])
        answer = self.judge.answer(places, partial(self._counterpart, ranked=[node for node, _ in ranked]))
        return self._without_scale(answer)

    def _without_scale(self, answer: RelocalizeAnswer) -> RelocalizeAnswer:
        """The answer, with what it cannot tell by photographs: how far away from them the view was taken."""
        nodes = [self._node_of(candidate.node) for candidate in answer.candidates]
        measured = [node is None or not node.landmarks.scale_share for node in nodes]
        candidates = tuple(
            replace(candidate, distance_known=known)
            for candidate, known in zip(answer.candidates, measured, strict=True)
        )
        place = answer.certainty is Certainty.FOUND and not measured[0]
        return replace(
            answer, certainty=Certainty.PLACE if place else answer.certainty, candidates=candidates
        )

    def _counterpart(self, place: PlaceHypothesis, ranked: Sequence[NodeId]) -> PlaceHypothesis | None:
        """Where the robot may be as well, by what the surroundings of a place look like."""
        best = place.best
        found = self._regions.counterpart(best, ranked)
        if found is None:
            return None
        twice = [pair for pair in best.recognition.pairs.tolist() if pair[1] in found.features]
        recognition = replace(best.recognition, node_from_robot=found.node_from_robot, pairs=np.array(twice))
        seen = NodeMatch(found.node, recognition)
        return PlaceHypothesis([seen], found.node_from_robot, found.features, found.nodes)

    def prepare(self, most: int) -> int:
        """Find out what at most so many nodes look like before anybody asks, and say how many are left."""
        return self._regions.prepare(most)

    def _closer(self, view: View, one: NodeMatch) -> NodeMatch:
        """A sighting with the pose that the pixels give at the noise that they have."""
        if (node := self._node_of(one.node)) is None:
            return one
        closer = refine_pose(node, view, one.recognition, self._settings.recognition.pose)
        return replace(one, recognition=replace(one.recognition, node_from_robot=closer))

    def doubled(self, view: View, best: NodeMatch, ranked: Sequence[tuple[NodeId, float]]) -> list[NodeMatch]:
        """Nodes elsewhere, of those that look like a view, that look like the node recognised best."""
        s, found, node = self._settings, [], self._node_of(best.node)
        for other in elsewhere(ranked, best.node, s.faint):
            double = self._node_of(other)
            if node is None or double is None:
                continue
            mapped = between(self._merged, other, best.node)
            if mapped is not None:
                pairs = match(double.landmarks.codes, node.landmarks.codes, s.recognition.matching)
                left = unexplained(double, pairs, node.landmarks.pixels, node.camera, mapped, EXPLAINED_PX)
                if left < s.recognition.least_inliers:
                    continue
            likeness = self.alike.compare(double, node)
            if likeness is None or (mapped is not None and same_place(mapped, likeness.node_from_robot.mean)):
                continue
            sighting = carried(double, likeness, best, view, s.recognition.matching, EXPLAINED_PX)
            if sighting.recognition.inliers >= SLIGHT * best.recognition.inliers:
                found.append(sighting)
        return found

    def _may_differ(
        self, node: Node, pairs: NDArray[np.int64], view: View, sightings: Sequence[NodeMatch]
    ) -> bool:
        """Whether a node may be a rival of those that were recognised.

        It is none if too few features match that the pose found does not explain already.
        """
        s = self._settings
        best = max(sightings, key=lambda sighting: sighting.recognition.inliers)
        least = max(s.recognition.least_inliers, SLIGHT * best.recognition.inliers)
        if len(pairs) < least:
            return False
        mapped = between(self._merged, node.id, best.node)
        if mapped is None:
            return True
        from_robot = mapped @ best.recognition.node_from_robot.mean
        return unexplained(node, pairs, view.pixels, view.camera, from_robot, EXPLAINED_PX) >= least


def _best_refusal(refusals: list[tuple[NodeId, Refusal]]) -> str:
    """The reason of the node that came nearest to being recognised."""
    if not refusals:
        return "the nodes that look like it are gone"
    node, refusal = max(refusals, key=lambda item: (item[1].inliers, item[1].matches, item[0]))
    return f"not recognised; nearest is {node}: {refusal.reason}"
