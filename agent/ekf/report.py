"""What a filter says of itself after an update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.pose import Array


@dataclass(frozen=True, eq=False)
class UpdateReport:
    """One update by the landmarks of one image.

    Attributes:
        ids: (N,) landmarks that were given, as they were given.
        accepted: (N,) which of them were believed; never those that the filter does not hold.
        innovations_px: (N, 2) px, measured minus expected before the update; NaN where there is none.
        mean_nis: normalised innovation squared over its degrees of freedom, of the accepted landmarks taken
            jointly; about 1 if the filter is consistent, NaN if nothing was accepted.
        healthy: whether the estimate was held up by enough landmarks that agree.
        reason: why not, in words; empty if healthy.
    """

    ids: NDArray[np.int64]
    accepted: NDArray[np.bool_]
    innovations_px: Array
    mean_nis: float
    healthy: bool
    reason: str

    @staticmethod
    def blind(ids: NDArray[np.int64], reason: str) -> UpdateReport:
        """The report of an update that had nothing to see."""
        n = len(ids)
        return UpdateReport(ids, np.zeros(n, np.bool_), np.full((n, 2), np.nan), float("nan"), False, reason)
