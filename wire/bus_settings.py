"""Where the fleet's router is."""

import ipaddress
import re
from dataclasses import dataclass
from typing import Literal

from mapweave.hybridmap.errors import SettingsError
from mapweave.wire.credentials import Credentials, RouterAccess

RETRY_FIRST = 0.1
"""Pause before the second attempt to connect, s; doubled each time."""
RETRY_LONGEST = 1.0
"""Longest pause between attempts to connect, s."""
NEXT_ENDPOINT = 2.0
"""s that a client with several endpoints spends on one of them."""
LEASE = 5.0
"""After what silence a participant counts as dead, s: clients of a silent router go to another one. With
2.5 s the clients of a busy router left it all at once, and came back all at once."""
AGENT_LEASE = 10.0
"""The same for agents, s; one whose process ends leaves at once. With 2.5 s a router dropped robots of a busy
computer, and all that came back at once were dropped again."""
QUEUE_LIMIT = 16384
"""Messages that may wait for this bus's handlers."""
ROUTER_QUEUE = 16
"""Batches a priority that a router holds for each of its clients."""


ENDPOINT = re.compile(r"(tcp|tls|quic|ws)/\S+:\d+(\?\S*)?(#\S*)?")

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def is_loopback(endpoint: str) -> bool:
    """Whether only this machine reaches an endpoint."""
    host = endpoint.partition("/")[2].partition("?")[0].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True, slots=True)
class BusSettings:
    """How a bus connects.

    Attributes:
        mode: a client of a router, or the router itself.
        endpoints: routers that a client tries; it takes the first that answers.
        listen: where a router waits for clients.
        routers: another router that a router joins: the clients of both reach each other then. At most one,
            so that routers form no circle.
        session: id of the Zenoh session, hexadecimal; empty for a random one.
        timestamps: whether what is published gets a time, without which nothing is kept for late subscribers.
        attempt: of a client to open a connection, s: so long a host that does not answer holds up the end of
            the process, and, up to `NEXT_ENDPOINT`, the next endpoint. Zenoh's own default is 10.
        lease: after what silence others count this one as dead, s.
        credentials: prove who this is; None on this machine alone.
        access: who is admitted by a router, and to what; None: all clients to everything.
        fleet: of the rules of `access`.
    """

    mode: Literal["client", "router"] = "client"
    endpoints: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    routers: tuple[str, ...] = ()
    session: str = ""
    timestamps: bool = False
    attempt: float = 10.0
    lease: float = LEASE
    credentials: Credentials | None = None
    access: RouterAccess | None = None
    fleet: str = "demo"

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
        if len(self.routers) > 1:
            # In a circle, a router that is silent for longer than its lease and then comes back is not found
            # any more (Zenoh 1.10: its transports are open again, and no routes lead there).
            raise SettingsError(
                f"a router joins one other, not {len(self.routers)}: a router that freezes for seconds would "
                "be lost in a circle of them; a map server without --listen takes several, as their client"
            )
        if self.routers and self.credentials is not None and not self.credentials.certified:
            # Who connects with a password does not learn who is at the other end.
            raise SettingsError("routers join each other with certificates, not with the passwords of a lab")
        for endpoint in (*used, *self.routers):
            if not ENDPOINT.fullmatch(endpoint):
                raise SettingsError(f"endpoint {endpoint!r}: endpoints look like {DEFAULT_ENDPOINT}")
            if self.mode == "router" and self.credentials is None and not is_loopback(endpoint):
                raise SettingsError(
                    f"without keys a router stays on this machine alone, not {endpoint}: make keys with "
                    "`mapweave keys init`, and give them with --keys"
                )
            if self.mode == "router" and self.credentials is None and endpoint.startswith("ws/"):
                # Zenoh does not look at the header Origin.
                raise SettingsError(
                    f"without keys a router takes no WebSockets, as {endpoint}: any page in a browser of "
                    "this machine could command robots; use tcp/, or give --keys"
                )
            if (
                self.credentials is not None
                and self.credentials.certified
                and not endpoint.startswith("tls/")
            ):
                raise SettingsError(f"endpoint {endpoint!r}: with certificates endpoints begin with tls/")
