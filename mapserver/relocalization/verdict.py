"""What follows from the nodes that were recognised in a view: places, rivals, and an answer in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, Whereabouts
from mapweave.mapserver.relocalization.aliased_landmarks import between
from mapweave.mapserver.relocalization.calibration import probabilities
from mapweave.mapserver.relocalization.place_hypotheses import NodeMatch, PlaceHypothesis, fuse, supported
from mapweave.merge.pose_graph.merged_map import MergedMap

ALONE = 18
"""Landmarks that must agree if one node speaks alone. Two nodes that say the same, found each by its own,
are much better evidence than one: parts of unlike places look alike."""


GATE = 16.3
"""Chi-square with 3 degrees of freedom within which two estimates agree."""
FLOOR_XY = 0.05
"""Error between two estimates that no covariance tells of, m."""
FLOOR_HEADING = 0.03
"""Heading error between two estimates that no covariance tells of, rad."""
COMPARABLE = 0.6
"""A second place is a rival if it explains so much of what the best one explains, or if so much of what it
should see is seen, as compared with the best one."""
SLIGHT = 0.25
"""A place that explains less of what the best one explains is no rival in any case."""


Elsewhere = Callable[[PlaceHypothesis], PlaceHypothesis | None]
"""Where a robot may be as well that seems to be at a place."""

NOWHERE = -1
"""Component of a node that is not in the merged map yet."""


class HypothesisSelector:
    """Puts what was recognised together, and answers. It stands for one merged map."""

    def __init__(self, merged: MergedMap) -> None:
        """Take where nodes are, and how strict to be."""
        self._merged = merged

    def places(self, sightings: Sequence[NodeMatch]) -> list[PlaceHypothesis]:
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
            places.append(PlaceHypothesis(agreeing, combined, features))
            left = others
        return sorted(places, key=lambda place: (-len(place.features), place.best.node))

    def _in_frame_of(self, node: NodeId, one: NodeMatch) -> PoseGaussian | None:
        """A sighting's estimate in another node's frame; None if the map does not join the two."""
        if node == one.node:
            return one.recognition.node_from_robot
        relative = self._merged.relative(node, one.node)
        return None if relative is None else relative @ one.recognition.node_from_robot

    def _agree(self, first: PoseGaussian, second: PoseGaussian) -> bool:
        between = first.inverse() @ second
        floor = np.diag([FLOOR_XY**2, FLOOR_XY**2, FLOOR_HEADING**2])
        d = between.mean.vector
        return float(d @ np.linalg.solve(between.covariance + floor, d)) < GATE

    def answer(self, places: Sequence[PlaceHypothesis], elsewhere: Elsewhere) -> RelocalizeAnswer:
        """Say where the robot is, if only one place comes into question.

        Args:
            places: that were recognised, best supported first.
            elsewhere: finds where a robot may be as well that seems to be at the first of them.
        """
        first = places[0]
        supports = supported(places)
        rivals = [
            place for place, support in zip(places, supports, strict=True)
            if len(place.features) >= COMPARABLE * len(first.features)
            or (
                len(place.features) >= SLIGHT * len(first.features)
                and support.seen >= COMPARABLE * supports[0].seen
            )
        ]  # fmt: skip
        if len(rivals) > 1:
            return self._ambiguous(places, rivals)
        best = first.best
        words = f"{best.recognition.inliers} landmarks of {best.node} agree"
        if len(first.sightings) == 1 and best.recognition.inliers < ALONE:
            return unknown(f"not sure: {words}, and no other node says the same")
        if all(one.lonely for one in first.sightings):
            return unknown(f"not sure: {words}, all on one thing, and nothing of what should be beside it")
        counterpart = elsewhere(first)
        if counterpart is not None:
            return self._ambiguous([*places, counterpart], [first, counterpart])
        if len(first.sightings) > 1:
            words += f", and {len(first.sightings) - 1} more nodes with them"
        return RelocalizeAnswer(Certainty.FOUND, self._candidates(places), words)

    def _ambiguous(
        self, places: Sequence[PlaceHypothesis], rivals: Sequence[PlaceHypothesis]
    ) -> RelocalizeAnswer:
        names = " or ".join(str(place.best.node) for place in rivals)
        most, least = len(rivals[0].features), len(rivals[-1].features)
        words = f"it may be {names}: they explain {most} to {least} features"
        if any(place.is_double for place in rivals):
            words += ", and look alike on the map"
        if any(place.nodes_around for place in rivals):
            words += f", and so do {max(place.nodes_around for place in rivals)} nodes around them"
        if any(between(self._merged, rivals[0].best.node, place.best.node) is None for place in rivals):
            words += ", and nothing joins their parts of the map yet"
        return RelocalizeAnswer(Certainty.AMBIGUOUS, self._candidates(places), words)

    def _candidates(self, places: Sequence[PlaceHypothesis]) -> tuple[Whereabouts, ...]:
        return tuple(map(self._whereabouts, places, probabilities(supported(places))))

    def _whereabouts(self, place: PlaceHypothesis, probability: float) -> Whereabouts:
        best = place.best
        placement = self._merged.poses.get(best.node)
        return Whereabouts(
            best.node,
            place.best_from_robot,
            None if placement is None else placement.merged_from_robot @ place.best_from_robot,
            NOWHERE if placement is None else placement.component,
            best.recognition.inliers,
            probability,
        )


def unknown(reason: str) -> RelocalizeAnswer:
    """No place, for a reason."""
    return RelocalizeAnswer(Certainty.UNKNOWN, (), reason)
