"""Places that were recognised in one view: what says so, how sure it is, and estimates put together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.node import NodeId
from hybridmap.pose import PoseGaussian
from hybridmap.recognition import Recognition
from mapserver.belief import Support


@dataclass(frozen=True, eq=False)
class Sighting:
    """A node that was recognised in the view."""

    node: NodeId
    recognition: Recognition


@dataclass(frozen=True, eq=False)
class SeenPlace:
    """Sightings that agree on one posture, best first.

    Attributes:
        sightings: of one place.
        best_from_robot: posture in the first one's frame, combined.
        features: of the view that they explain together.
    """

    sightings: list[Sighting]
    best_from_robot: PoseGaussian
    features: frozenset[int]

    @property
    def best(self) -> Sighting:
        """The one of most landmarks."""
        return self.sightings[0]


def supported(places: Sequence[SeenPlace]) -> list[Support]:
    """What speaks for each of the places that were recognised in one view."""
    found = []
    for place in places:
        one = place.best.recognition
        others = max((len(other.features) for other in places if other is not place), default=0)
        share, against = one.inliers / max(one.usable, 1), others / len(place.features)
        found.append(Support(one.inliers, share, one.evidence["seen"], len(place.sightings), against))
    return found


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
