"""The publishers of a Zenoh session, one for each key in use."""

import threading
from collections import OrderedDict

import zenoh

MOST = 50_000
"""Publishers that are kept: a server acknowledges to each of its robots on a key of its own."""


class Publishers:
    """Publishers by key, the least recently used first.

    A router looks once who wants what a publisher sends. For a message on a key that is not declared it
    looks through all that the fleet has declared, each time: 6 and 150 us a message with 1000 robots.
    """

    def __init__(self, most: int = MOST) -> None:
        """None is declared yet.

        Args:
            most: publishers that are kept.
        """
        self._most = most
        self._by_key: OrderedDict[str, zenoh.Publisher] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Publishers that are declared."""
        return len(self._by_key)

    def of(self, session: zenoh.Session, key: str) -> zenoh.Publisher:
        """The publisher of a key, declared when it is first used.

        Raises:
            zenoh.ZError: the session is closed.
        """
        with self._lock:
            publisher = self._by_key.get(key)
            if publisher is not None:
                self._by_key.move_to_end(key)
                return publisher
        # It takes milliseconds beside a thousand robots: messages on other keys do not wait for it.
        declared = session.declare_publisher(key)
        with self._lock:
            publisher = self._by_key.setdefault(key, declared)
            if len(self._by_key) > self._most:
                # Another thread may be sending by it now. Zenoh takes it back when the last one lets it go.
                self._by_key.popitem(last=False)
        return publisher
