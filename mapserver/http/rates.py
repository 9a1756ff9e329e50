"""How often one person may ask what takes long: one who asks without end harms no other."""

import math
import time
from collections.abc import Callable
from http import HTTPStatus

from starlette.exceptions import HTTPException

from mapweave.mapserver.quotas import TokenBucket

QUESTIONS = 2.0
"""A second, over 20 s: `mapserver.quotas.BURST`. The page asks a question a click, and one a photograph."""
LIMITED = frozenset({"relocalize", "explain"})
"""Questions that a worker is busy with for long."""
MOST_PEOPLE = 4096
"""Buckets that are kept; one more replaces the oldest."""


class Rates:
    """Rates of requests by person; by address on a fleet without keys. Used by the server's thread alone."""

    def __init__(self, rate: float = QUESTIONS, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin without any.

        Args:
            rate: questions a second.
            clock: only grows, s.
        """
        self._rate, self._clock = rate, clock
        self._buckets: dict[str, TokenBucket] = {}

    def ask(self, who: str, questions: int = 1) -> None:
        """Someone asks so many questions at once; refused ones do not count.

        Raises:
            HTTPException: 429, that one asks too much.
        """
        now = self._clock()
        bucket = self._buckets.get(who)
        if bucket is None:
            if len(self._buckets) >= MOST_PEOPLE:
                del self._buckets[next(iter(self._buckets))]
            bucket = self._buckets[who] = TokenBucket(self._rate, now)
        wait = bucket.wait(questions, now)
        if wait <= 0.0:
            bucket.spend(questions, now)
            return
        seconds = math.ceil(wait)
        raise HTTPException(
            HTTPStatus.TOO_MANY_REQUESTS,
            f"{who} asks more than {self._rate:g} questions a second: try again in {seconds} s",
            {"Retry-After": str(seconds)},
        )
