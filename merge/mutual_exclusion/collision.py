"""Collisions: two robots that cannot both have been where a merge puts them, and why in words."""

from dataclasses import dataclass

WORDS = ("would have seen", "would have been at the same place")
"""Each reason has some of these."""


def is_exclusion(reason: str) -> bool:
    """Whether a link was refused since two robots exclude each other."""
    return any(words in reason for words in WORDS)


@dataclass(frozen=True)
class Collision:
    """Two robots that would have been at the same place at the same time, or would have seen each other.

    Attributes:
        first: agent; the robot that would have seen the other.
        second: another one.
        clock: that says so.
        moments: how many moments they would have been too near, or seen each other.
        nearest: how near they would have been, m.
        time: when that was, s.
        evidence: natural logarithm of the odds against the merge.
        where: the first would have seen the second, in words; empty if they would have been in one place.
    """

    first: str
    second: str
    clock: str
    moments: int
    nearest: float
    time: float
    evidence: float
    where: str = ""

    @property
    def reason(self) -> str:
        """The reason in words."""
        if self.where:
            return (
                f"{self.first} would have seen {self.second} {self.nearest:.1f} m {self.where} "
                f"at {self.time:.1f} s of clock {self.clock}; its sensors saw nothing there, "
                f"{self.moments} such moments"
            )
        return (
            f"{self.first} and {self.second} would have been at the same place at the same time: "
            f"{self.nearest:.2f} m apart at {self.time:.1f} s of clock {self.clock}, "
            f"{self.moments} such moments"
        )
