"""Where the fleet's router is."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from mapweave.hybridmap.errors import SettingsError

ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/\S+:\d+(\?\S*)?(#\S*)?")

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, slots=True)
class BusSettings:
    """How a bus connects.

    Attributes:
        mode: a client of a router, or the router itself.
        endpoints: where a client looks for a router; it takes the first that answers.
        listen: where a router waits for clients.
        retry_first: pause before the second attempt to connect, s; doubled each time.
        retry_longest: longest pause, s.
        lease: after what silence a participant counts as dead, s.
        queue_limit: messages that may wait for this bus's handlers.
        router_queue: batches a priority that a router holds for each of its clients.
    """

    mode: Literal["client", "router"] = "client"
    endpoints: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    retry_first: float = 0.1
    retry_longest: float = 1.0
    lease: float = 2.5
    queue_limit: int = 16384
    router_queue: int = 16

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
        if not 0 < self.retry_first <= self.retry_longest:
            raise SettingsError("bus: retry_first must be positive and at most retry_longest")
        if self.lease <= 0 or self.queue_limit < 1 or not 1 <= self.router_queue <= 16:
            raise SettingsError("bus: lease and queue_limit must be positive, router_queue in 1..16")
