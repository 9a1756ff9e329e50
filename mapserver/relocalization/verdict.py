"""The verdict: at which places the view may have been taken, and whether one is certain. The last step."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegions
from mapweave.mapserver.relocalization.place_hypotheses import ALONE, NodeMatch, PlaceHypothesis, fuse
from mapweave.mapserver.relocalization.view_registration import Registration
from mapweave.mapserver.retrieval.ranking import IncompleteSearch
from mapweave.merge.pose_graph.merged_map import MergedMap

GATE = 16.3
"""Chi-square with 3 degrees of freedom within which two estimates agree."""
FLOOR_XY = 0.05
"""Error between two estimates beyond their covariances, m."""
FLOOR_HEADING = 0.03
"""Heading error between two estimates that no covariance tells of, rad."""
COMPARABLE = 0.6
"""A second place is a rival if it explains so much of what the best one explains."""


class Outcome(Enum):
    """What a verdict comes to: one place, several, or why none."""

    FOUND = auto()
    AMBIGUOUS = auto()
    FEW_FEATURES = auto()
    NO_CANDIDATE = auto()
    NOT_RECOGNISED = auto()
    ONE_WEAK_NODE = auto()
    """A single node supports it, with few landmarks, and nothing speaks against it."""
    ONE_THING = auto()
    """All landmarks that agree are on one thing, which may have been moved."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What follows from a registration.

    Attributes:
        outcome: of it.
        registration: the grounds.
        places: that come into question, best supported first.
        rivals: more than one if ambiguous: places that explain the view about as well as the first.
        confirmable: another view that gives the same place would make it certain: it lacks nothing but
            landmarks.
        missing: in words, what of the map could not be searched; empty if all of it was.
    """

    outcome: Outcome
    registration: Registration
    places: Sequence[PlaceHypothesis] = ()
    rivals: Sequence[PlaceHypothesis] = ()
    confirmable: bool = False
    missing: str = ""


class HypothesisSelector:
    """Groups recognitions into places, and decides between them. It belongs to one merged map."""

    def __init__(self, merged: MergedMap, aliasing: AliasedRegions, least_features: int) -> None:
        """Take where nodes are, and which regions look alike.

        Args:
            merged: where nodes are.
            aliasing: which other regions look like that of a recognised place.
            least_features: a view with fewer has no candidates.
        """
        self._merged, self._aliasing = merged, aliasing
        self._least_features = least_features

    def decide(self, registration: Registration) -> Verdict:
        """The robot's pose if only one place is possible, or why not."""
        try:
            return replace(self._decided(registration), missing=registration.candidates.missing)
        except IncompleteSearch as error:
            return replace(self._decided(registration, aliases=False), missing=str(error))

    def _decided(self, registration: Registration, aliases: bool = True) -> Verdict:
        places = self.places(registration)
        rivals = self._rivals(places)
        outcome = self._refusal(registration, places, rivals)
        weak = outcome is Outcome.ONE_WEAK_NODE and not places[0].best.one_thing
        if outcome is not None and not weak:
            return Verdict(outcome, registration, places, rivals)
        ranked = [node for node, _ in registration.candidates.ranked]
        elsewhere = registration.candidates.elsewhere
        counterpart = self._counterpart(places[0], ranked, elsewhere) if aliases else None
        if counterpart is None:
            return Verdict(outcome or Outcome.FOUND, registration, places, rivals, weak)
        places, rivals = [*places, counterpart], [places[0], counterpart]
        return Verdict(outcome or Outcome.AMBIGUOUS, registration, places, rivals)

    def _refusal(
        self,
        registration: Registration,
        places: Sequence[PlaceHypothesis],
        rivals: Sequence[PlaceHypothesis],
    ) -> Outcome | None:
        """Why no single place is certain, the first reason that holds; None if none does."""
        matches, ranked = places[0].matches if places else [], registration.candidates.ranked
        reasons = (
            (Outcome.FEW_FEATURES, not ranked and len(registration.candidates.view) < self._least_features),
            (Outcome.NO_CANDIDATE, not ranked),
            (Outcome.NOT_RECOGNISED, not matches),
            (Outcome.AMBIGUOUS, len(rivals) > 1),
            (
                Outcome.ONE_WEAK_NODE,
                len(matches) == 1 and matches[0].recognition.inliers < ALONE,
            ),
            (Outcome.ONE_THING, all(match.one_thing for match in matches)),
        )
        return next((outcome for outcome, holds in reasons if holds), None)

    def places(self, registration: Registration) -> list[PlaceHypothesis]:
        """Group the recognised nodes into places.

        Nodes agree if their poses do, within what the map and the recognitions are certain of. The best
        supported place is the first.
        """
        left = sorted(registration.matches, key=lambda match: (-match.recognition.inliers, match.node))
        places = []
        while left:
            best, left = left[0], left[1:]
            combined, agreeing, remaining = best.recognition.node_from_robot, [best], []
            for match in left:
                estimate = self._in_frame_of(best.node, match)
                if estimate is None or not _agree(best.recognition.node_from_robot, estimate):
                    remaining.append(match)
                    continue
                agreeing.append(match)
                combined = fuse(combined, estimate)
            features = frozenset(int(f) for match in agreeing for f in match.recognition.pairs[:, 1])
            places.append(PlaceHypothesis(agreeing, combined, features))
            left = remaining
        return sorted(places, key=lambda place: (-len(place.features), place.best.node))

    def _counterpart(
        self, place: PlaceHypothesis, ranked: Sequence[NodeId], elsewhere: Collection[MapId]
    ) -> PlaceHypothesis | None:
        """Another pose where the robot may be, by aliased surroundings of a place."""
        best = place.best
        region = self._aliasing.counterpart(best, ranked, elsewhere)
        if region is None:
            return None
        twice = [pair for pair in best.recognition.pairs.tolist() if pair[1] in region.features]
        recognition = replace(best.recognition, node_from_robot=region.node_from_robot, pairs=np.array(twice))
        match = NodeMatch(region.node, recognition)
        return PlaceHypothesis([match], region.node_from_robot, region.features, region.nodes)

    def _in_frame_of(self, node: NodeId, match: NodeMatch) -> PoseGaussian | None:
        """A match's estimate in another node's frame; None if the map does not join the two."""
        if node == match.node:
            return match.recognition.node_from_robot
        relative = self._merged.relative(node, match.node)
        return None if relative is None else relative @ match.recognition.node_from_robot

    def _rivals(self, places: Sequence[PlaceHypothesis]) -> list[PlaceHypothesis]:
        """Places that explain the view about as well as the first, which is among them."""
        return [place for place in places if len(place.features) >= COMPARABLE * len(places[0].features)]


def _agree(first: PoseGaussian, second: PoseGaussian) -> bool:
    difference = first.inverse() @ second
    floor = np.diag([FLOOR_XY**2, FLOOR_XY**2, FLOOR_HEADING**2])
    d = difference.mean.vector
    return float(d @ np.linalg.solve(difference.covariance + floor, d)) < GATE
