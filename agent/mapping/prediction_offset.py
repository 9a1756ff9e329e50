"""How far tracks are from where the filter expects them, while wheels are trusted alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array


class PredictionOffset:
    """Tracks that are followed and do not correct the filter: too few, or all in one corner.

    In between the wheels' error grows, and the filter's predictions of all tracks are off by a common motion.
    The motion from one image to the next it still predicts.
    """

    def __init__(self) -> None:
        """None: the filter is where the tracks are."""
        self.forget()

    def forget(self) -> None:
        """The filter is where the tracks are."""
        self._ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self._aside: Array = np.zeros((0, 2))

    def note(self, ids: NDArray[np.int64], pixels: Array, expected: Array) -> None:
        """Take note of where tracks are and were not expected.

        Args:
            ids: (N,) tracks, each once.
            pixels: (N, 2) px, where they are.
            expected: (N, 2) px, where the filter has them; NaN where it has them nowhere.
        """
        order = np.argsort(ids)
        self._ids, self._aside = ids[order], np.nan_to_num((pixels - expected)[order])

    def aside(self, ids: NDArray[np.int64]) -> Array:
        """(N, 2) px, how far tracks are from where the filter expects them; zeros for those not noted."""
        out = np.zeros((len(ids), 2))
        if len(self._ids):
            place = self._ids.searchsorted(ids)
            matching = self._ids.take(place, mode="clip") == ids
            out[matching] = self._aside[place[matching]]
        return out
