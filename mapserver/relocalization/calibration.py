"""Calibration: the probability that a robot is at a recognised place, from the evidence for and against it.

A logistic regression on views of simulated buildings, with truth, by `python -m benchmarks.fit_belief`; its
buildings are not those on which benchmarks.relocalize measures.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.pose import Array

COEFFICIENTS = (1.078, 0.378, 1.095, -0.033, 0.082, -3.171)
"""Of `Support.numbers`, as the script printed them."""


@dataclass(frozen=True)
class HypothesisSupport:
    """Evidence of one place among those that were recognised in a view.

    Attributes:
        inliers: landmarks of its best node that agree.
        share: of the matches that could have agreed.
        seen: share of the landmarks that should be in the view that are.
        matches: recognised nodes.
        others: features that the strongest other place explains, as a share of those that this one does.
    """

    inliers: int
    share: float
    seen: float
    matches: int
    others: float

    @property
    def numbers(self) -> Array:
        """(6,) what is weighed."""
        return np.array(
            [
                1.0,
                math.log(self.inliers),
                self.share,
                self.seen,
                min(self.matches, 3),
                min(self.others, 3.0),
            ]
        )


def probabilities(
    places: Sequence[HypothesisSupport], weights: Sequence[float] = COEFFICIENTS
) -> list[float]:
    """That the robot is at each of the places that were recognised in one view, 0 to 1, at most 1 in all."""
    alone = [1.0 / (1.0 + math.exp(-float(np.dot(weights, place.numbers)))) for place in places]
    total = max(1.0, sum(alone))
    return [weight / total for weight in alone]
