"""Tells a lost robot where it is: look up, recognise, compare the places with each other, answer honestly.

An answer is FOUND only if every place that explains the view about as well is the same place. Whether two
places are the same is asked of the merged map: the postures that they give must agree within what the map and
the recognitions are certain of.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybridmap.closer import look_closer
from hybridmap.matching import match
from hybridmap.node import Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.query import Certainty, RelocalizeAnswer, View, Whereabouts
from hybridmap.recognition import Recognition, RecognitionSettings, Refusal, examine_matches
from mapserver.belief import probabilities
from mapserver.doubles import Doubles, carried, elsewhere, same_place, unexplained
from mapserver.seenplaces import SeenPlace, Sighting, fuse, is_lonely, supported
from merge.merged import MergedMap


class Retrieval(Protocol):
    """Finds nodes that look like a view, for example mapserver.placeindex.PlaceIndex."""

    def query(self, view: View, k: int = 5) -> list[tuple[NodeId, float]]:
        """At most k nodes with how much they look like it, best first."""
        ...


NOWHERE = -1
"""Component of a node that is not in the merged map yet."""


@dataclass(frozen=True)
class RelocalizationSettings:
    """How a view is answered.

    Attributes:
        recognition: when a view counts as recognised.
        candidates: nodes that are compared with the view.
        gate: chi-square with 3 degrees of freedom within which two estimates agree.
        floor_xy: error between two estimates that no covariance tells of, m.
        floor_heading: the same, rad.
        alone: landmarks that must agree if one node speaks alone. Two nodes that say the same, found each
            by its own, are much better evidence than one: parts of unlike places look alike.
        explained_px: a match nearer than this to where a posture found elsewhere expects it speaks for that.
        faint: a node that looks so much less like the view than one that was recognised is not looked at.
        comparable: a second place is a rival if it explains so much of what the best one explains, or if
            so much of what it should see is seen, as compared with the best one.
        slight: a place that explains less of what the best one explains is no rival in any case.
    """

    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)
    candidates: int = 16
    gate: float = 16.3
    floor_xy: float = 0.05
    floor_heading: float = 0.03
    comparable: float = 0.6
    slight: float = 0.25
    explained_px: float = 12.0
    faint: float = 0.25
    alone: int = 18


class Relocalizer:
    """Answers where views were taken. It stands for one merged map; make another for the next."""

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        settings: RelocalizationSettings | None = None,
        doubles: Doubles | None = None,
    ) -> None:
        """Take what is known.

        Args:
            index: which nodes look like a view; may know nodes that the merged map does not know yet.
            node_of: gives a node by its id, for example `Merger.node`.
            merged: where nodes are.
            settings: how.
            doubles: which nodes look alike; outlives the merged map, so that it is found out once.
        """
        self._index = index
        self._node_of = node_of
        self._merged = merged
        self._settings = settings or RelocalizationSettings()
        self._doubles = doubles or Doubles(self._settings.recognition)

    def answer(self, view: View) -> RelocalizeAnswer:
        """Say where a view was taken, or that it is not known, with the reason in words."""
        s = self._settings
        if len(view) < s.recognition.least_inliers:
            return _unknown(f"the view has {len(view)} features; {s.recognition.least_inliers} are needed")
        ranked = self._index.query(view, s.candidates)
        if not ranked:
            return _unknown("no node of any map has features like these")
        sightings, refusals = self.look(view, ranked)
        return self.conclude(view, sightings, ranked) if sightings else _unknown(_best_refusal(refusals))

    def look(
        self, view: View, ranked: Sequence[tuple[NodeId, float]]
    ) -> tuple[list[Sighting], list[tuple[NodeId, Refusal]]]:
        """Compare a view with nodes, as far as it can matter.

        Args:
            view: the image's features.
            ranked: nodes with how much they look like it, best first.

        Returns:
            Those that were recognised, and why others were not.
        """
        s = self._settings
        sightings: list[Sighting] = []
        refusals: list[tuple[NodeId, Refusal]] = []
        best_score = 0.0
        for node_id, score in ranked:
            sure = any(one.recognition.inliers >= s.alone for one in sightings)
            node = self._node_of(node_id)
            if node is None or (sure and score < s.faint * best_score):
                continue
            pairs = match(node.landmarks.codes, view.codes, s.recognition.matching)
            if sure and not self._may_differ(node, pairs, view, sightings):
                continue
            seed = zlib.crc32(view.codes.tobytes(), zlib.crc32(str(node_id).encode()))
            verdict = examine_matches(node, view, pairs, s.recognition, np.random.default_rng(seed))
            if isinstance(verdict, Recognition):
                lonely = is_lonely(node, view.camera, verdict)
                sightings.append(Sighting(node_id, verdict, lonely=lonely))
                best_score = max(best_score, score)
            else:
                refusals.append((node_id, verdict))
        return sightings, refusals

    def conclude(
        self, view: View, sightings: Sequence[Sighting], ranked: Sequence[tuple[NodeId, float]]
    ) -> RelocalizeAnswer:
        """Say what follows from the nodes that were recognised.

        Args:
            view: the image's features.
            sightings: these.
            ranked: nodes with how much they look like the view, best first; those that look like the one that
                was recognised best are thought of too.
        """
        if not sightings:
            return _unknown("no node was recognised")
        best, *others = sorted(sightings, key=lambda one: (-one.recognition.inliers, one.node))
        best = self._closer(view, best)
        return self._judge(self.places([best, *others, *self.doubled(view, best, ranked)]))

    def _closer(self, view: View, one: Sighting) -> Sighting:
        """A sighting with the posture that the pixels give at the noise that they have."""
        if (node := self._node_of(one.node)) is None:
            return one
        closer = look_closer(node, view, one.recognition, self._settings.recognition.pose)
        return replace(one, recognition=replace(one.recognition, node_from_robot=closer))

    def doubled(self, view: View, best: Sighting, ranked: Sequence[tuple[NodeId, float]]) -> list[Sighting]:
        """Nodes elsewhere, of those that look like a view, that look like the node recognised best."""
        s, found, node = self._settings, [], self._node_of(best.node)
        for other in elsewhere(ranked, best.node, s.faint):
            double = self._node_of(other)
            if node is None or double is None:
                continue
            mapped = self._between(other, best.node)
            if mapped is not None:
                pairs = match(double.landmarks.codes, node.landmarks.codes, s.recognition.matching)
                left = unexplained(double, pairs, node.landmarks.pixels, node.camera, mapped, s.explained_px)
                if left < s.recognition.least_inliers:
                    continue
            likeness = self._doubles.compare(double, node)
            if likeness is None or (mapped is not None and same_place(mapped, likeness.node_from_robot.mean)):
                continue
            sighting = carried(double, likeness, best, view, s.recognition.matching, s.explained_px)
            if sighting.recognition.inliers >= s.slight * best.recognition.inliers:
                found.append(sighting)
        return found

    def _between(self, a: NodeId, b: NodeId) -> Pose2 | None:
        """Posture `a_from_b` on the merged map; None if that does not join the two."""
        component = self._merged.component_of(a)
        if component is None or component != self._merged.component_of(b):
            return None
        return self._merged.pose(a).inverse() @ self._merged.pose(b)

    def _may_differ(
        self, node: Node, pairs: NDArray[np.int64], view: View, sightings: Sequence[Sighting]
    ) -> bool:
        """Whether a node may be a rival of those that were recognised.

        It is none if too few features match that the posture found does not explain already.
        """
        s = self._settings
        best = max(sightings, key=lambda sighting: sighting.recognition.inliers)
        least = max(s.recognition.least_inliers, s.slight * best.recognition.inliers)
        if len(pairs) < least:
            return False
        mapped = self._between(node.id, best.node)
        if mapped is None:
            return True
        from_robot = mapped @ best.recognition.node_from_robot.mean
        return unexplained(node, pairs, view.pixels, view.camera, from_robot, s.explained_px) >= least

    def places(self, sightings: Sequence[Sighting]) -> list[SeenPlace]:
        """Group the sightings by agreement, best supported place first."""
        left = sorted(sightings, key=lambda one: (-one.recognition.inliers, one.node))
        places = []
        while left:
            best, left = left[0], left[1:]
            combined, agreeing, others = best.recognition.node_from_robot, [best], []
            for one in left:
                estimate = self._in_frame_of(best.node, one)
                if estimate is None or not self._agree(best.recognition.node_from_robot, estimate):
                    others.append(one)
                    continue
                agreeing.append(one)
                combined = fuse(combined, estimate)
            features = frozenset(int(f) for one in agreeing for f in one.recognition.pairs[:, 1])
            places.append(SeenPlace(agreeing, combined, features))
            left = others
        return sorted(places, key=lambda place: (-len(place.features), place.best.node))

    def _in_frame_of(self, node: NodeId, one: Sighting) -> PoseGaussian | None:
        """A sighting's estimate in another node's frame; None if the map does not join the two."""
        if node == one.node:
            return one.recognition.node_from_robot
        relative = self._merged.relative(node, one.node)
        return None if relative is None else relative @ one.recognition.node_from_robot

    def _agree(self, first: PoseGaussian, second: PoseGaussian) -> bool:
        s = self._settings
        between = first.inverse() @ second
        floor = np.diag([s.floor_xy**2, s.floor_xy**2, s.floor_heading**2])
        d = between.mean.vector
        return float(d @ np.linalg.solve(between.covariance + floor, d)) < s.gate

    def _judge(self, places: list[SeenPlace]) -> RelocalizeAnswer:
        s = self._settings
        most = len(places[0].features)
        supports = supported(places)
        rivals = [
            place for place, support in zip(places, supports, strict=True)
            if len(place.features) >= s.comparable * most
            or (len(place.features) >= s.slight * most and support.seen >= s.comparable * supports[0].seen)
        ]  # fmt: skip
        candidates = tuple(map(self._whereabouts, places, probabilities(supports)))
        best = places[0].best
        words = f"{best.recognition.inliers} landmarks of {best.node} agree"
        if len(rivals) == 1:
            if len(places[0].sightings) == 1 and best.recognition.inliers < s.alone:
                return _unknown(f"not sure: {words}, and no other node says the same")
            if all(one.lonely for one in places[0].sightings):
                return _unknown(
                    f"not sure: {words}, all on one thing, and nothing of what should be beside it"
                )
            if len(places[0].sightings) > 1:
                words += f", and {len(places[0].sightings) - 1} more nodes with them"
            return RelocalizeAnswer(Certainty.FOUND, candidates, words)
        names = " or ".join(str(place.best.node) for place in rivals)
        words = f"it may be {names}: they explain {most} to {len(rivals[-1].features)} features"
        if any(place.is_double for place in rivals):
            words += ", and look alike on the map"
        if any(self._between(best.node, place.best.node) is None for place in rivals):
            words += ", and nothing joins their parts of the map yet"
        return RelocalizeAnswer(Certainty.AMBIGUOUS, candidates, words)

    def _whereabouts(self, place: SeenPlace, probability: float) -> Whereabouts:
        best = place.best
        placement = self._merged.postures.get(best.node)
        return Whereabouts(
            best.node,
            place.best_from_robot,
            None if placement is None else placement.merged_from_robot @ place.best_from_robot,
            NOWHERE if placement is None else placement.component,
            best.recognition.inliers,
            probability,
        )


def _best_refusal(refusals: list[tuple[NodeId, Refusal]]) -> str:
    """The reason of the node that came nearest to being recognised."""
    if not refusals:
        return "the nodes that look like it are gone"
    node, refusal = max(refusals, key=lambda item: (item[1].inliers, item[1].matches, item[0]))
    return f"not recognised; nearest is {node}: {refusal.reason}"


def _unknown(reason: str) -> RelocalizeAnswer:
    return RelocalizeAnswer(Certainty.UNKNOWN, (), reason)
