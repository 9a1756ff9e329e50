"""Clock for stamps: nanoseconds since 1970, without steps when the system clock is set."""

import time

_EPOCH_NS = time.time_ns() - time.monotonic_ns()
"""System time at zero of the monotonic clock; read once, so that stamps never step."""


def now_ns() -> int:
    """The current time."""
    return _EPOCH_NS + time.monotonic_ns()


class RemoteClock:
    """Stamps of another computer's clock as this computer's.

    While that clock agrees with this one to within what messages may take, its stamps are taken as they are.
    Otherwise the quickest message tells how far it is off.
    """

    FARTHEST_NS = 1_000_000_000
    """No message takes longer."""

    def __init__(self) -> None:
        """Start with clocks that agree."""
        self._offset_ns = 0

    def local(self, stamp_ns: int, arrived_ns: int) -> int:
        """This computer's time of a stamp.

        Args:
            stamp_ns: of the other computer; 0 if it has not said.
            arrived_ns: when it arrived, `now_ns`.
        """
        if not stamp_ns:
            return arrived_ns
        ago = arrived_ns - stamp_ns
        if not self._offset_ns <= ago < self._offset_ns + self.FARTHEST_NS:
            self._offset_ns = ago
        return stamp_ns + self._offset_ns

    def remote(self, stamp_ns: int) -> int:
        """The other computer's time of a stamp of this one."""
        return stamp_ns - self._offset_ns


def of_monotonic_ns(monotonic_ns: int) -> int:
    """Stamp of a monotonic clock reading."""
    return _EPOCH_NS + monotonic_ns
