"""Places that an exploring robot could not reach, and when it tries each of them again."""

from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.pose import Array

FIRST = 60.0
"""A place that could not be reached is avoided for so long, s: people and robots go on. The second time it is
avoided for twice as long."""
MOST = 3
"""After so many times it is avoided for good: what blocks the way stays there, and exploration must end."""


@dataclass
class _Avoided:
    """A place.

    Attributes:
        position: (2,) m, in map.
        times: that it could not be reached.
        until: s; it is avoided until then.
    """

    position: Array
    times: int
    until: float


class AvoidedPlaces:
    """Places that one robot keeps away from while it explores. Times are seconds of its exploration."""

    def __init__(self, spacing: float) -> None:
        """Every place may be tried.

        Args:
            spacing: least distance between two places, m; what is nearer is the same.
        """
        self._spacing = spacing
        self._avoided: list[_Avoided] = []

    def add(self, position: Array, now: float) -> None:
        """Avoid a place that was not reached.

        Args:
            position: (2,) m, in map.
            now: s.
        """
        for known in self._avoided:
            if np.linalg.norm(known.position - position) < self._spacing:
                known.times += 1
                known.until = now + FIRST * 2.0 ** (known.times - 1)
                return
        self._avoided.append(_Avoided(position, 1, now + FIRST))

    def places(self, now: float) -> list[Array]:
        """Positions that are avoided at a time, (2,) m each, in map."""
        return [known.position for known in self._avoided if known.times >= MOST or now < known.until]

    def next_try(self, now: float) -> float | None:
        """When the next place that is avoided now may be tried again, s; None if none of them ever is."""
        waits = [known.until for known in self._avoided if known.times < MOST and now < known.until]
        return min(waits, default=None)
