"""Encounters: the common moments of two robots, and their evidence about a merge."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.visibility_intervals import VisibilityInterval
from mapweave.merge.settings import ExclusionSettings

WINDOW = 2.0
"""Moments within this time count as one observation, s."""
LEAST_WINDOWS = 3
"""Windows that must each make the merge half as likely, at least. Chosen: with fewer, one wrong pose or one
failed scan of 2 s could refute a true merge by itself (docs/decisions/exclusion.md)."""
NEIGHBOURHOOD = 5.0
"""Robots further apart than this many least distances are no evidence for or against."""


@dataclass(frozen=True, eq=False)
class Encounter:
    """Moments of two robots.

    Attributes:
        times: (T,) s.
        known: (T,) whether both are known to be somewhere.
        distances: (T,) m, between them.
        close: (K,) indices of moments when they are too near.
        seen: M observations of the other robot's expected place.
        least_apart: what is too near, m.
    """

    times: Array
    known: NDArray[np.bool_]
    distances: Array
    close: NDArray[np.int64]
    seen: VisibilityInterval
    least_apart: float

    def _windows(self) -> NDArray[np.int64]:
        """(T,) number of the window of time in which a moment is; -1 where it is not known of both."""
        windows = np.floor(self.times / WINDOW).astype(np.int64)
        _, seats = np.unique(windows[self.known], return_inverse=True)
        out = np.full(len(windows), -1, np.int64)
        out[self.known] = seats
        return out

    def by_footprints(self, clear: Array) -> Array:
        """(W,) logarithms of the odds against the merge that each window of time gives.

        Args:
            clear: (K,) chances that they were clear of each other after all in the moments that are close.
        """
        # A footprint takes this share of the neighbourhood; without it many moments would prove anything.
        free = 1.0 - NEIGHBOURHOOD**-2
        odds = np.where(self.distances < NEIGHBOURHOOD * self.least_apart, free, 1.0)
        odds[self.close] = free / clear
        seats = self._windows()[self.known]
        # Moments of one window hang together: the mean of their odds is fair all the same, a product is not.
        out: Array = np.log(np.bincount(seats, odds[self.known]) / np.bincount(seats))
        return out

    def by_visibility(self, odds: Array) -> Array:
        """(S, W) the same of what they should have seen.

        Args:
            odds: (S, M) against the merge, of each observation.
        """
        seats = self._windows()
        windows, count = seats[self.seen.moments], int(seats.max()) + 1
        counts = np.bincount(windows, minlength=count)
        sums = np.array([np.bincount(windows, row, minlength=count) for row in odds])
        out: Array = np.log(np.where(counts > 0, sums / np.maximum(counts, 1), 1.0))
        return out

    def refuses(self, clear: Array, odds: Array, weights: Array, s: ExclusionSettings) -> bool:
        """Whether that is enough to refuse a merge.

        Args:
            clear: as in `by_footprints`.
            odds: as in `by_visibility`.
            weights: (S,) how probable each way is in which poses may be wrong.
            s: what is enough.
        """
        by_window, total = self.added(clear, odds, weights)
        # What was enough at any time is enough: later meetings do not make it possible.
        windows = np.cumsum(by_window > math.log(2.0))
        return bool(((windows >= LEAST_WINDOWS) & (total >= -math.log(s.doubt))).any())

    def added(self, clear: Array, odds: Array, weights: Array) -> tuple[Array, Array]:
        """(W,) logarithms of the odds against the merge that each window adds to those before, and (W,) sums.

        Over all ways in which poses may be wrong, each as probable as it is: the later windows meet those
        that the earlier ones have left.
        """
        import scipy.special

        by_way = np.cumsum(self.by_footprints(clear) + self.by_visibility(odds), axis=1)
        total: Array = -scipy.special.logsumexp(-by_way, axis=0, b=weights[:, None])
        added: Array = np.diff(total, prepend=0.0)
        return added, total

    def evidence(self, clear: Array, odds: Array, weights: Array) -> tuple[float, float]:
        """Log odds by footprints and by mutual visibility, at their maximum; arguments as of `added`."""
        by_footprints = np.cumsum(self.by_footprints(clear))
        _, total = self.added(clear, odds, weights)
        most = int(np.argmax(total))
        return float(by_footprints[most]), float(total[most] - by_footprints[most])

    def ample(self, clear: Array, odds: Array, s: ExclusionSettings) -> int:
        """Number of moments after which there is twice as much evidence as is asked for; all, if never."""
        evidence = np.cumsum(self.by_footprints(clear) + self.by_visibility(odds)[0])
        enough = np.flatnonzero(evidence >= -2.0 * math.log(s.doubt))
        seats = self._windows()
        return int(np.flatnonzero(seats == enough[0])[-1]) + 1 if len(enough) else len(seats)
