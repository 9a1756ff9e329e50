"""Sessions of people in browsers, and failed attempts to log in. Both are kept in memory, with limits."""

import ipaddress
import secrets
import time
from collections import deque
from collections.abc import Callable

from mapweave.identities.logins import Login

LIFE = 12 * 3600.0
"""Of a session, s: a day's work. Then the token is asked for again."""
MOST_SESSIONS = 1024
"""One more ends the oldest."""
MOST_FAILURES = 10
"""Of an address, within `WINDOW`; then it has to wait."""
WINDOW = 60.0
"""s"""
MOST_ADDRESSES = 4096
"""Whose failures are remembered; one more forgets the one that failed longest ago."""

Clock = Callable[[], float]


class Sessions:
    """Sessions by the secret in a browser's cookie."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        """Begin with none.

        Args:
            clock: only grows, s.
        """
        self._clock = clock
        self._open: dict[str, tuple[Login, float]] = {}

    def begin(self, login: Login) -> str:
        """A new session; returns its secret."""
        if len(self._open) >= MOST_SESSIONS:
            del self._open[next(iter(self._open))]
        secret = secrets.token_urlsafe(32)
        self._open[secret] = login, self._clock() + LIFE
        return secret

    def find(self, secret: str) -> Login | None:
        """Whose session it is; None if there is none, or its time is over."""
        login, end = self._open.get(secret, (None, 0.0))
        if login is not None and self._clock() >= end:
            self.end(secret)
            return None
        return login

    def end(self, secret: str) -> None:
        """End a session. Twice is no error."""
        self._open.pop(secret, None)


IPV6_NETWORK = 64
"""Bits: who has one address of IPv6 has all of this network."""


class FailedAttempts:
    """Failed attempts, by address; of IPv6 by network."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        """Begin with none.

        Args:
            clock: only grows, s.
        """
        self._clock = clock
        self._times: dict[str, deque[float]] = {}

    def wait(self, address: str) -> float:
        """How long an address has to wait before its next attempt, s; 0 if it may try."""
        times = self._times.get(_counted(address))
        if times is None or len(times) < MOST_FAILURES:
            return 0.0
        return max(times[0] + WINDOW - self._clock(), 0.0)

    def add(self, address: str) -> None:
        """Note a failure."""
        address = _counted(address)
        times = self._times.pop(address, None) or deque(maxlen=MOST_FAILURES)
        times.append(self._clock())
        if len(self._times) >= MOST_ADDRESSES:
            del self._times[next(iter(self._times))]
        self._times[address] = times


def _counted(address: str) -> str:
    """The network of an address of IPv6, and any other word as it is."""
    try:
        known = ipaddress.IPv6Address(address)
    except ValueError:
        return address
    if known.ipv4_mapped is not None:
        return str(known.ipv4_mapped)
    return str(ipaddress.IPv6Network((int(known), IPV6_NETWORK), strict=False))
