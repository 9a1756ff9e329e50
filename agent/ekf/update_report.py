"""Report of a filter after an update."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array


class Health(StrEnum):
    """What supports an estimate, or what it lacks. The covariance says how much it loses by that."""

    GOOD = "good"
    SLIP = "wheels refuted"
    """Landmarks agree that the robot did not move as its wheels measured: slip, a lost encoder."""
    NO_PARALLAX = "no parallax"
    """The robot stands still or turns on the spot: depths stay as unknown as they are."""
    FEW = "few landmarks"
    """Too few are in view to tell wrong from right ones; all are used."""
    DISAGREEMENT = "landmarks disagree"
    """Too few of those in view agree with each other and the wheels."""
    BLIND = "no landmark in view"
    """Dark, a covered lens, or the robot faces elsewhere."""
    NO_IMAGE = "no image"
    """The camera dropped frames: only the wheels move the estimate on."""

    @property
    def held_up(self) -> bool:
        """Whether landmarks hold the pose up."""
        return self in (Health.GOOD, Health.SLIP, Health.NO_PARALLAX)


@dataclass(frozen=True, eq=False)
class UpdateReport:
    """One update by the landmarks of one image.

    Attributes:
        accepted: (N,) which of the landmarks given were accepted; never those that the filter does not hold.
        innovations_px: (N, 2) px, measured minus expected before the update; NaN where there is none.
        mean_nis: normalised innovation squared over its degrees of freedom, of the accepted landmarks taken
            jointly; about 1 if the filter is consistent, NaN if nothing was accepted.
        health: what held the estimate up.
        reason: what is wrong, in words and figures; empty if nothing is.
    """

    accepted: NDArray[np.bool_]
    innovations_px: Array
    mean_nis: float
    health: Health = Health.GOOD
    reason: str = ""

    @property
    def healthy(self) -> bool:
        """Whether the estimate was held up by enough landmarks that agree."""
        return self.health.held_up

    @staticmethod
    def blind(count: int, reason: str) -> UpdateReport:
        """The report of an update that saw none of so many landmarks."""
        none = np.zeros(count, np.bool_)
        return UpdateReport(none, np.full((count, 2), np.nan), float("nan"), Health.BLIND, reason)
