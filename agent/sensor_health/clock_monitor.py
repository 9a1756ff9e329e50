"""Whether the clock of the observations goes on as time does."""

STANDS = 0.5
"""s for which stamps may stay the same."""
AHEAD = 10.0
"""s; a longer step is a clock that was set, or a robot whose program did not run. Both are stood out."""
STEADY = 1.0
"""s of even stamps after which a clock is believed again: also one that was set for good."""


class ClockMonitor:
    """Compares the stamps of successive observations.

    Attributes:
        fault: what is wrong, in words; empty if nothing is.
        jumps: how often the clock has jumped so far.
    """

    def __init__(self, tick: float) -> None:
        """Begin without a stamp.

        Args:
            tick: time between two observations, s.
        """
        self.fault = ""
        self.jumps = 0
        self._tick = tick
        self._ahead = max(AHEAD, 10.0 * tick)
        self._stamp_ns: int | None = None
        self._stood = self._steady = 0.0

    def see(self, stamp_ns: int) -> None:
        """Take in the stamp of an observation."""
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if before is None:
            return
        step = (stamp_ns - before) * 1e-9
        if step == 0.0:
            self._stood, self._steady = self._stood + self._tick, 0.0
            if self._stood > max(STANDS, self._tick):
                self.fault = "the clock of the observations stands still"
        elif 0.0 < step <= self._ahead:
            self._stood, self._steady = 0.0, self._steady + self._tick
            if self._steady > STEADY:
                self.fault = ""
        else:
            self._stood = self._steady = 0.0
            self.jumps += 1
            self.fault = (
                f"the clock of the observations has jumped back by {-step:.1f} s"
                if step < 0.0
                else f"the clock of the observations has jumped ahead by {step:.1f} s, "
                "or the robot's program stood for so long"
            )
