"""Tracks that a filter keeps refusing are on something that moves, or have slid: they are given up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RejectionCounter:
    """Counts how often in a row each track was refused."""

    def __init__(self, most: int) -> None:
        """Set how many refusals in a row a track may have before it is given up."""
        self._most = most
        self._counts: dict[int, int] = {}

    def judge(self, ids: NDArray[np.int64], accepted: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Count (N,) tracks accepted or refused; returns those to give up, whose count begins again."""
        given_up = []
        for track, good in zip(ids.tolist(), accepted.tolist(), strict=True):
            strikes = 0 if good else self._counts.get(track, 0) + 1
            if strikes >= self._most:
                given_up.append(track)
                strikes = 0
            self._counts[track] = strikes
        return np.array(given_up, np.int64)

    def forget(self) -> None:
        """Reset all counters."""
        self._counts = {}
