"""What one robot may send and ask: more waits, so that a robot that floods the server harms itself.

Nothing is lost by a quota. A change that is held back is not acknowledged: it stays on the robot's disk and is
pulled later. A question is refused with a time to retry.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.errors import Busy

log = logging.getLogger(__name__)

BURST = 20.0
"""s of its rate that a robot may send or ask at once: a kilobyte of changes is a robot's minute."""
CHANGE_BYTES = 16_384
"""Of a change, on average. A node of an honest robot has 3 kB; its largest is 128 kB."""
LANDMARKS = 500
"""Of a node, on average over a robot's maps. An honest robot's have about 100, a photograph's at most 400."""
REMEMBERED = 10.0
"""s after which a robot that is within its quotas again is no longer shown."""


@dataclass(frozen=True)
class QuotaSettings:
    """What the server takes of one robot at most.

    Attributes:
        changes: of its maps, per second, over 20 s. A robot that maps sends about one in 2 s; the rest serves
            a robot that sends what it has mapped without a network.
        questions: per second, over 20 s. A robot asks two at most.
        maps: that are not retired. A robot begins a new one when it cannot find itself in the last.
        nodes: of its maps together. A robot makes one in 10 s.
    """

    changes: Annotated[float, Meta(gt=0.0)] = 50.0
    questions: Annotated[float, Meta(gt=0.0)] = 10.0
    maps: Annotated[int, Meta(ge=1)] = 64
    nodes: Annotated[int, Meta(ge=1)] = 20_000

    @property
    def landmarks(self) -> int:
        """Landmarks of a robot's maps together."""
        return LANDMARKS * self.nodes


class TokenBucket:
    """How much a sender may send now; a debt is waited for."""

    def __init__(self, rate: float, now: float) -> None:
        """Start full.

        Args:
            rate: what comes back a second.
            now: the time, s.
        """
        self._rate, self._tokens, self._at = rate, BURST * rate, now

    def available(self, now: float) -> float:
        """What may be sent now."""
        self._tokens = min(BURST * self._rate, self._tokens + self._rate * max(now - self._at, 0.0))
        self._at = max(now, self._at)
        return self._tokens

    def spend(self, amount: float, now: float) -> None:
        """Something came, allowed or not."""
        self._tokens = self.available(now) - amount

    def wait(self, amount: float, now: float) -> float:
        """After how many seconds so much may be sent."""
        return max(min(amount, BURST * self._rate) - self.available(now), 0.0) / self._rate


@dataclass
class _Excess:
    """What was held back of one robot: how often by kind, and when last."""

    counts: dict[str, int] = field(default_factory=dict)
    last: float = 0.0
    asked: TokenBucket | None = None


class Quotas:
    """Counts what is over the quotas, by robot, and admits questions. Thread-safe."""

    def __init__(self, settings: QuotaSettings | None = None, clock: Callable[[], float] = lambda: 0.0) -> None:
        """Start with no robot.

        Args:
            settings: how much.
            clock: the time, s.
        """
        self.settings = settings or QuotaSettings()
        self.clock = clock
        self._lock = threading.Lock()
        self._robots: dict[str, _Excess] = {}

    def hold_back(self, robot: str, what: str, count: int = 1) -> None:
        """Note that something of a robot is held back, and log it at each power of two."""
        with self._lock:
            excess = self._robots.setdefault(robot, _Excess())
            before = excess.counts.get(what, 0)
            after = excess.counts[what] = before + count
            excess.last = self.clock()
        if before.bit_length() != after.bit_length():
            log.warning("%s is over its quota: %d %s held back so far", robot, after, what)

    def ask(self, robot: str) -> None:
        """A robot asks something. People (no name) have no quota here: HTTP has its own limits.

        Raises:
            Busy: it asks too much.
        """
        if not robot:
            return
        now = self.clock()
        with self._lock:
            excess = self._robots.setdefault(robot, _Excess())
            if excess.asked is None:
                excess.asked = TokenBucket(self.settings.questions, now)
            wait = excess.asked.wait(1.0, now)
            if wait <= 0.0:
                excess.asked.spend(1.0, now)
                return
        self.hold_back(robot, "questions")
        raise Busy(wait)

    def words(self, robot: str) -> str:
        """What is held back of a robot that was over its quotas just now; empty if it was not."""
        with self._lock:
            excess = self._robots.get(robot)
            if excess is None or not excess.counts or self.clock() > excess.last + REMEMBERED:
                return ""
            held = ", ".join(f"{count} {what}" for what, count in sorted(excess.counts.items()))
        return f"over its quota: {held} held back"

    def over(self) -> str:
        """All robots that were over their quotas just now, in words; empty without any."""
        with self._lock:
            names = sorted(self._robots)
        return "; ".join(f"{name} is {words}" for name in names if (words := self.words(name)))
