"""What one robot may send and ask: more waits, so that a robot that floods the server harms itself.

Nothing is lost by a quota. A change that is held back is not acknowledged: it stays on the robot's disk and
is pulled later. A question is refused with a time to retry.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import Busy

log = logging.getLogger(__name__)

BURST = 20.0
"""s of its rate that a robot may send or ask at once: half an hour of mapping without a network."""
CHANGE_BYTES = 16_384
"""Of a change, on average. Those of the demo have 1 kB on average and 3.2 kB at most; 128 kB is allowed."""
LANDMARKS = 500
"""Of a node, on average over a robot's maps. Those of the demo have 100, those of photographs at most 400."""
EDGES, DRIVEN = 16, 16_000
"""Edges of a node, on average over a robot's maps, and of drives on maps of others. The demo has 3 a node."""
MOST_ROBOTS = 4096
"""Robots of which this is remembered: without keys, names cost nothing."""
REMEMBERED = 10.0
"""s after which a robot that is within its quotas again is no longer shown."""


@dataclass(frozen=True)
class QuotaSettings:
    """What the server takes of one robot at most.

    Attributes:
        changes: of its maps, per second, over 20 s. Robots of the demo send 0.7, and 8 within a second. More
            is for those that send what they mapped without a network.
        questions: per second, over 20 s. A robot asks one after the other.
        maps: that are not retired. A robot begins one when it cannot find itself in its last.
        nodes: of its maps together. Robots of the demo make one in 4 s.
        megabytes: of its changes that are kept. Superseded ones count until they are deleted, when they are
            as much as the rest. 20 000 nodes like those of the demo, with their edges, are 60 MB.
    """

    changes: Annotated[float, Meta(gt=0.0)] = 50.0
    questions: Annotated[float, Meta(gt=0.0)] = 10.0
    maps: Annotated[int, Meta(ge=1)] = 64
    nodes: Annotated[int, Meta(ge=1)] = 20_000
    megabytes: Annotated[float, Meta(gt=0.0)] = 512.0

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
    """What was held back of one robot: how often by kind, and when last. And what it may ask."""

    asked: TokenBucket
    counts: dict[str, int] = field(default_factory=dict)
    last: float = 0.0


class Quotas:
    """Counts what is over the quotas, by robot, and admits questions. Thread-safe."""

    def __init__(
        self, settings: QuotaSettings | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.settings = settings or QuotaSettings()
        self.clock = clock
        self._lock = threading.Lock()
        self._robots: dict[str, _Excess] = {}
        self._totals: dict[str, int] = {}

    def hold_back(self, robot: str, what: str) -> None:
        """Note that something of a robot is held back, and log it at each power of two."""
        if not robot:
            return
        with self._lock:
            excess = self._excess(robot)
            before = excess.counts.get(what, 0)
            after = excess.counts[what] = before + 1
            excess.last = self.clock()
            self._totals[what] = self._totals.get(what, 0) + 1
        if before.bit_length() != after.bit_length():
            held = counted(after, what.removesuffix("s"))
            log.warning("%s is over its quota: %s held back so far", robot, held, extra={"robot": robot})

    def ask(self, robot: str) -> None:
        """A robot asks something. People (no name) have no quota here: HTTP has its own limits.

        Raises:
            Busy: it asks too much.
        """
        if not robot:
            return
        now = self.clock()
        with self._lock:
            excess = self._excess(robot)
            wait = excess.asked.wait(1.0, now)
            if wait <= 0.0:
                excess.asked.spend(1.0, now)
                return
        self.hold_back(robot, "questions")
        raise Busy(wait)

    def _excess(self, robot: str) -> _Excess:
        if robot not in self._robots:
            if len(self._robots) >= MOST_ROBOTS:
                del self._robots[next(iter(self._robots))]
            self._robots[robot] = _Excess(TokenBucket(self.settings.questions, self.clock()))
        return self._robots[robot]

    def totals(self) -> dict[str, int]:
        """What was held back of all robots since the start, by kind."""
        with self._lock:
            return dict(self._totals)

    def over(self) -> dict[str, str]:
        """Robots that were over their quotas just now, with what is held back of each, in words."""
        now = self.clock()
        with self._lock:
            return {
                name: "over its quota: "
                + ", ".join(counted(n, what.removesuffix("s")) for what, n in sorted(excess.counts.items()))
                for name, excess in sorted(self._robots.items())
                if excess.counts and now <= excess.last + REMEMBERED
            }
