"""When an agent's beacons are due: while an acknowledgement is overdue, and rarely while nothing happens.

When one is overdue follows from how long those before took (RFC 6298, as TCP does). A fixed time is too short
for servers of a large fleet, or behind a slow link: beacons for changes that are only on their way make them
later still.
"""

GAIN, DEVIATION_GAIN = 1 / 8, 1 / 4
"""Weights of the newest measurement in the mean time and in its mean deviation (RFC 6298, 2.3)."""
DEVIATIONS = 4
"""So many deviations behind the mean time an acknowledgement is overdue (RFC 6298, 2.3)."""


class AckTimer:
    """Times one acknowledgement after the other. It has no lock and no clock of its own; times are in s."""

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


SETTLED_BEACONS = 20
"""In the time of so many beacons, or statuses that servers want, a map that servers have sends one: a server
that has lost it learns so."""
RAREST = 4
"""A beacon on which nothing follows is sent again after twice the time, up to so many times that of the
first: the beacons of a fleet that a server cannot keep up with must not hold it up further."""


class BeaconTimer:
    """Times the beacons of all maps of one agent. It has no lock and no clock of its own; times are in s.

    Attributes:
        due: when the next beacon is.
    """

    def __init__(self, interval: float) -> None:
        """All are due at once.

        Args:
            interval: shortest time from a change to its beacon.
        """
        self._interval = interval
        self._acks = AckTimer(interval, SETTLED_BEACONS * interval)
        self._pause = interval
        self.due = self._all_due = 0.0

    def hasten(self, now: float) -> None:
        """The next beacon is due, and those behind it at the usual times."""
        self._pause = self._acks.timeout
        self.due = min(self.due, now)

    def changed(self, now: float) -> None:
        """A map has changed: the next beacon is due when the acknowledgement is overdue."""
        self.hasten(now + self._acks.timeout)

    def server_came(self, now: float) -> None:
        """A server is there that may have lost its store, or be new: the beacons of all maps are due."""
        self._all_due = 0.0
        self._acks.forget()
        self.hasten(now)

    def published(self, sequence: int, now: float) -> None:
        """A change of the map that is being made has left."""
        self._acks.sent(sequence, now)

    def asked_for(self, first: int, last: int) -> None:
        """A server has asked for changes of that map."""
        self._acks.asked_for(first, last)

    def settled(self, watermark: int, now: float) -> None:
        """All of that map that is up to a sequence number is acknowledged."""
        self._acks.settled(watermark, now)

    def some_settled(self, now: float) -> None:
        """Some changes are acknowledged: the others have the whole time again (RFC 6298, 5.3)."""
        self.due = self._all_due
        self.changed(now)

    def all_due(self, now: float, status_period: float) -> bool:
        """Whether the beacons of all maps are due, and not only of those of which servers lack something.

        Args:
            now: when the beacons are sent.
            status_period: between two statuses that servers want; 0: they want no fewer.
        """
        if now < self._all_due:
            return False
        self._all_due = now + SETTLED_BEACONS * max(self._interval, status_period)
        return True

    def sent(self, now: float, lacking: bool) -> None:
        """The beacons that were due are sent.

        Args:
            now: when.
            lacking: whether servers lack anything.
        """
        self.due = self._all_due
        if lacking:
            self.due = min(now + self._pause, self.due)
            self._pause = min(2 * self._pause, RAREST * self._acks.timeout)
