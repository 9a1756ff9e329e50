"""Places for questions in work. A body that is still on its way takes none: slow clients hold up no other."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from mapweave.hybridmap.errors import Busy

MOST_AT_ONCE = 32
"""Questions that are in work at once; the next one is refused."""
PLACE = "mapweave.place"
"""In the scope of a request: its place."""


class Arrivals:
    """Bodies on their way. Beyond a bound the oldest of the client that sends most of them is given up."""

    def __init__(self, most: int = MOST_AT_ONCE) -> None:
        """Begin without any."""
        self._most = most
        self._senders: dict[asyncio.Timeout, str] = {}

    @asynccontextmanager
    async def one(self, who: str, patience: float) -> AsyncIterator[None]:
        """A body of `who` arrives, within `patience` seconds.

        Raises:
            TimeoutError: it takes longer, or was given up.
        """
        async with asyncio.timeout(patience) as limit:
            self._senders[limit] = who
            try:
                if len(self._senders) > self._most:
                    self._give_up_one()
                yield
            finally:
                self._senders.pop(limit, None)

    def _give_up_one(self) -> None:
        (most, _), *_ = Counter(self._senders.values()).most_common(1)
        oldest = next(limit for limit, who in self._senders.items() if who == most)
        del self._senders[oldest]
        oldest.reschedule(0.0)


class Places:
    """All places. Used by the server's thread alone."""

    def __init__(self) -> None:
        """Begin with all of them free."""
        self.taken = 0
        # Apart: who has no login keeps no member's image from arriving.
        self.of_members, self.of_strangers = Arrivals(), Arrivals()


class Place:
    """The place of one question. Leave it, whatever happens."""

    def __init__(self, places: Places) -> None:
        """Not taken yet."""
        self._places, self._has, self._who, self._arrivals = places, False, "", places.of_strangers

    def take(self) -> None:
        """Take it.

        Raises:
            Busy: all are taken.
        """
        if self._places.taken >= MOST_AT_ONCE:
            raise Busy(1.0)
        self._places.taken += 1
        self._has = True

    def leave(self) -> None:
        """Leave it, if it is taken."""
        self._places.taken -= self._has
        self._has = False

    def sent_by(self, who: str, member: bool) -> None:
        """Who asks: the name of a member of the fleet, or the address of a stranger."""
        self._who = who
        self._arrivals = self._places.of_members if member else self._places.of_strangers

    @asynccontextmanager
    async def left(self, patience: float) -> AsyncIterator[None]:
        """Leave it while the body arrives, and take it again.

        Raises:
            TimeoutError: the body does not arrive in time, s, or others send one after it.
            Busy: all are taken then.
        """
        self.leave()
        async with self._arrivals.one(self._who, patience):
            yield
        self.take()
