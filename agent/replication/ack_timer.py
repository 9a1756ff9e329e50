"""When an acknowledgement is overdue, from how long the ones before took: RFC 6298, as TCP does.

A fixed time is too short for servers of a large fleet, or behind a slow link: beacons for changes that are
only on their way make them later still.
"""

from __future__ import annotations

GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4
"""Weights of the newest measurement in the mean time and in its mean deviation (RFC 6298, 2.3)."""
DEVIATIONS = 4
"""So many deviations behind the mean time an acknowledgement is overdue (RFC 6298, 2.3)."""


class AckTimer:
    """Times one change after the other. It has no lock and no clock of its own; times are in s."""

    def __init__(self, least: float, most: float) -> None:
        """Start without measurements.

        Args:
            least: shortest time after which one is overdue; also before any has come.
            most: longest.
        """
        self._least, self._most = least, most
        self._mean: float | None = None
        self._deviation = 0.0
        self._timed: tuple[int, float] | None = None

    @property
    def timeout(self) -> float:
        """Time from sending to when the acknowledgement is overdue."""
        if self._mean is None:
            return self._least
        return min(max(self._mean + DEVIATIONS * self._deviation, self._least), self._most)

    def sent(self, sequence: int, now: float) -> None:
        """A change was published."""
        if self._timed is None:
            self._timed = sequence, now

    def asked_for(self, first: int, last: int) -> None:
        """A server has asked for changes: they were lost, and say nothing about the way (Karn's rule)."""
        if self._timed is not None and first <= self._timed[0] <= last:
            self._timed = None

    def settled(self, watermark: int, now: float) -> None:
        """All that is up to a sequence number is acknowledged."""
        if self._timed is None or watermark < self._timed[0]:
            return
        took = now - self._timed[1]
        self._timed = None
        if self._mean is None:
            self._mean, self._deviation = took, took / 2
        else:
            self._deviation += DEVIATION_GAIN * (abs(took - self._mean) - self._deviation)
            self._mean += GAIN * (took - self._mean)

    def forget(self) -> None:
        """The change that is timed waits for a server that was away."""
        self._timed = None
