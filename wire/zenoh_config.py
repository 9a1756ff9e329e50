"""The session settings: no scouting, only the configured endpoints."""

from __future__ import annotations

from mapweave.wire.bus_settings import LEASE, RETRY_FIRST, RETRY_LONGEST, ROUTER_QUEUE, BusSettings

ACCEPT_PENDING = 1000
"""Connections of which a router does not know yet who they are."""
ACCEPT_TIMEOUT = 2.0
"""s; a silent new connection is dropped after this time. A handshake takes two round trips."""


def session_values(settings: BusSettings) -> dict[str, object]:
    """Zenoh's configuration, by path."""
    retry = {
        "period_init_ms": round(RETRY_FIRST * 1e3),
        "period_max_ms": round(RETRY_LONGEST * 1e3),
        "period_increase_factor": 2,
    }
    values: dict[str, object] = {
        "mode": settings.mode,
        "connect/endpoints": list(settings.endpoints) if settings.mode == "client" else [],
        "listen/endpoints": list(settings.listen) if settings.mode == "router" else [],
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # There is no scouting, so opening a router need not wait half a second for it.
        "scouting/delay": 1,
        # With Zenoh's own 100 and 10 s, a hundred idle connections keep all others out for 10 s.
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": round(ACCEPT_TIMEOUT * 1e3),
        "transport/unicast/open_timeout": round(settings.attempt * 1e3),
        "transport/link/tx/lease": round(LEASE * 1e3),
        "transport/link/tx/queue/size/data": ROUTER_QUEUE if settings.mode == "router" else 2,
        "transport/shared_memory/enabled": False,
    }
    if settings.session:
        values["id"] = settings.session
    if settings.timestamps:
        values["timestamping/enabled"] = True
    return values
