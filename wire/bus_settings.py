"""Where the fleet's router is."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from mapweave.hybridmap.errors import SettingsError

RETRY_FIRST = 0.1
"""Pause before the second attempt to connect, s; doubled each time."""
RETRY_LONGEST = 1.0
"""Longest pause between attempts to connect, s."""
LEASE = 2.5
"""After what silence a participant counts as dead, s."""
QUEUE_LIMIT = 16384
"""Messages that may wait for this bus's handlers."""
ROUTER_QUEUE = 16
"""Batches a priority that a router holds for each of its clients."""


ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/\S+:\d+(\?\S*)?(#\S*)?")

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, slots=True)
class BusSettings:
    """How a bus connects.

    Attributes:
        mode: a client of a router, or the router itself.
        endpoints: routers that a client tries; it takes the first that answers.
        listen: where a router waits for clients.
        session: id of the Zenoh session, hexadecimal; empty for a random one.
        timestamps: whether what is published gets a time, without which nothing is kept for late subscribers.
        attempt: of a client to open a connection, s: so long a host that does not answer holds up the next
            endpoint, and the end of the process. Zenoh's own default is 10.
    """

    mode: Literal["client", "router"] = "client"
    endpoints: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    session: str = ""
    timestamps: bool = False
    attempt: float = 10.0

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            SettingsError: a mode, endpoint or number that cannot work.
        """
        if self.mode not in ("client", "router"):
            raise SettingsError(f"bus mode {self.mode!r}: use client or router")
        used = self.endpoints if self.mode == "client" else self.listen
        if not used:
            raise SettingsError("bus: give at least one endpoint, for example " + DEFAULT_ENDPOINT)
        for endpoint in used:
            if not ENDPOINT.fullmatch(endpoint):
                raise SettingsError(f"endpoint {endpoint!r}: endpoints look like {DEFAULT_ENDPOINT}")
