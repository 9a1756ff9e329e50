"""Tells a lost robot where it is: look up, recognise, compare the places with each other, answer honestly.

An answer is FOUND only if every place that explains the view about as well is the same place. Whether two
places are the same is asked of the merged map: the postures that they give must agree within what the map and
the recognitions are certain of.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hybridmap.node import Node, NodeId
from hybridmap.pose import PoseGaussian
from hybridmap.query import Certainty, RelocalizeAnswer, View, Whereabouts
from hybridmap.recognition import Recognition, RecognitionSettings, Refusal, examine_view
from mapserver.placeindex import PlaceIndex
from merge.merged import MergedMap

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
        comparable: support of a second place, as a share of the best one's, that makes it ambiguous.
    """

    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)
    candidates: int = 8
    gate: float = 16.3
    floor_xy: float = 0.05
    floor_heading: float = 0.03
    comparable: float = 0.6
    alone: int = 18


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A node that was recognised in the view."""

    node: NodeId
    recognition: Recognition


@dataclass(frozen=True, eq=False)
class _Place:
    """Sightings that agree on one posture, best first.

    Attributes:
        sightings: of one place.
        best_from_robot: posture in the first one's frame, combined.
        features: of the view that they explain together.
    """

    sightings: list[_Sighting]
    best_from_robot: PoseGaussian
    features: frozenset[int]

    @property
    def best(self) -> _Sighting:
        return self.sightings[0]


class Relocalizer:
    """Answers where views were taken. It stands for one merged map; make another for the next."""

    def __init__(
        self,
        index: PlaceIndex,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        settings: RelocalizationSettings | None = None,
    ) -> None:
        """Take what is known.

        Args:
            index: which nodes look like a view; may know nodes that the merged map does not know yet.
            node_of: gives a node by its id, for example `Merger.node`.
            merged: where nodes are.
            settings: how.
        """
        self._index = index
        self._node_of = node_of
        self._merged = merged
        self._settings = settings or RelocalizationSettings()

    def answer(self, view: View) -> RelocalizeAnswer:
        """Say where a view was taken, or that it is not known, with the reason in words."""
        s = self._settings
        if len(view) < s.recognition.least_inliers:
            return _unknown(f"the view has {len(view)} features; {s.recognition.least_inliers} are needed")
        ranked = self._index.query(view, s.candidates)
        if not ranked:
            return _unknown("no node of any map has features like these")
        sightings: list[_Sighting] = []
        refusals: list[tuple[NodeId, Refusal]] = []
        for node_id, _ in ranked:
            node = self._node_of(node_id)
            if node is None:
                continue
            seed = zlib.crc32(view.codes.tobytes(), zlib.crc32(str(node_id).encode()))
            verdict = examine_view(node, view, s.recognition, np.random.default_rng(seed))
            if isinstance(verdict, Recognition):
                sightings.append(_Sighting(node_id, verdict))
            else:
                refusals.append((node_id, verdict))
        if not sightings:
            return _unknown(_best_refusal(refusals))
        return self._judge(self._places(sightings))

    def _places(self, sightings: list[_Sighting]) -> list[_Place]:
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
            places.append(_Place(agreeing, combined, features))
            left = others
        return sorted(places, key=lambda place: (-len(place.features), place.best.node))

    def _in_frame_of(self, node: NodeId, one: _Sighting) -> PoseGaussian | None:
        """A sighting's estimate in another node's frame; None if the map does not join the two."""
        relative = self._merged.relative(node, one.node)
        return None if relative is None else relative @ one.recognition.node_from_robot

    def _agree(self, first: PoseGaussian, second: PoseGaussian) -> bool:
        s = self._settings
        between = first.inverse() @ second
        floor = np.diag([s.floor_xy**2, s.floor_xy**2, s.floor_heading**2])
        d = between.mean.vector
        return float(d @ np.linalg.solve(between.covariance + floor, d)) < s.gate

    def _judge(self, places: list[_Place]) -> RelocalizeAnswer:
        s = self._settings
        most = len(places[0].features)
        rivals = [place for place in places if len(place.features) >= s.comparable * most]
        total = sum(len(place.features) for place in places)
        candidates = tuple(self._whereabouts(place, len(place.features) / total) for place in places)
        best = places[0].best
        words = f"{best.recognition.inliers} landmarks of {best.node} agree"
        if len(rivals) == 1:
            if len(places[0].sightings) == 1 and best.recognition.inliers < s.alone:
                return _unknown(f"not sure: {words}, and no other node says the same")
            if len(places[0].sightings) > 1:
                words += f", and {len(places[0].sightings) - 1} more nodes with them"
            return RelocalizeAnswer(Certainty.FOUND, candidates, words)
        names = " or ".join(str(place.best.node) for place in rivals)
        words = f"it may be {names}: they explain {most} to {len(rivals[-1].features)} features"
        if any(self._merged.relative(best.node, place.best.node) is None for place in rivals):
            words += ", and nothing joins their parts of the map yet"
        return RelocalizeAnswer(Certainty.AMBIGUOUS, candidates, words)

    def _whereabouts(self, place: _Place, share_of_support: float) -> Whereabouts:
        best = place.best
        placement = self._merged.postures.get(best.node)
        return Whereabouts(
            best.node,
            place.best_from_robot,
            None if placement is None else placement.merged_from_robot @ place.best_from_robot,
            NOWHERE if placement is None else placement.component,
            best.recognition.inliers,
            probability(best.recognition) * share_of_support,
        )


def probability(recognition: Recognition) -> float:
    """That a recognition is of the right place, before it is compared with other places.

    A logistic curve over the inliers and their share of the usable matches, set by hand: 10 inliers at half
    of the matches give 0.73, 20 at 80 % 0.985, 40 at 90 % 0.9999. It knows nothing of how often places look
    alike.
    """
    share = recognition.inliers / max(recognition.usable, 1)
    logit = 1.0 + (recognition.inliers - 10) / 5.0 + 4.0 * (share - 0.5)
    return 1.0 / (1.0 + math.exp(-logit))


def fuse(first: PoseGaussian, second: PoseGaussian) -> PoseGaussian:
    """Combine two estimates of one posture whose errors may have anything in common.

    Covariance intersection (Julier and Uhlmann 1997) with the weight that gives the smallest trace: the same
    view and often the same landmarks are behind both, so adding their information would count them twice.
    """
    difference = (first.mean.inverse() @ second.mean).vector
    information = [np.linalg.inv(one.covariance + 1e-12 * np.eye(3)) for one in (first, second)]
    best: tuple[float, float] = (math.inf, 0.0)
    for weight in np.linspace(0.0, 1.0, 11):
        together = np.linalg.inv((1 - weight) * information[0] + weight * information[1])
        best = min(best, (float(together.trace()), float(weight)))
    weight = best[1]
    covariance = np.linalg.inv((1 - weight) * information[0] + weight * information[1])
    step = covariance @ (weight * information[1] @ difference)
    mean = first.mean @ type(first.mean).from_vector(step)
    return PoseGaussian(mean, 0.5 * (covariance + covariance.T))


def _best_refusal(refusals: list[tuple[NodeId, Refusal]]) -> str:
    """The reason of the node that came nearest to being recognised."""
    if not refusals:
        return "the nodes that look like it are gone"
    node, refusal = max(refusals, key=lambda item: (item[1].inliers, item[1].matches, item[0]))
    return f"not recognised; nearest is {node}: {refusal.reason}"


def _unknown(reason: str) -> RelocalizeAnswer:
    return RelocalizeAnswer(Certainty.UNKNOWN, (), reason)
