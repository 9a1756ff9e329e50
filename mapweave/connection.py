"""Connections of commands and programs that need a router or a server now, and what they say without one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from mapweave.hybridmap.errors import NotConnected

if TYPE_CHECKING:
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.zenoh_bus import ZenohBus

SOON = 1.0
"""s; a router that is there is found sooner. Commands say within 2 s of their start that there is none."""
ANSWERED = 2.0
"""s; a server or robot that is there answers sooner."""


def reach(settings: BusSettings, advice: str = "give --connect") -> ZenohBus:
    """A connection of a client that needs a router now.

    Args:
        settings: of the client; the first endpoint in reach is taken.
        advice: what else a person can do.

    Raises:
        NotConnected: there is none.
    """
    from mapweave.wire.zenoh_bus import ZenohBus

    bus = ZenohBus(replace(settings, attempt=SOON / len(settings.endpoints)))
    if not bus.wait_connected(SOON):
        bus.close()
        where = ", ".join(settings.endpoints)
        raise NotConnected(f"no router at {where}: start `mapweave server`, or {advice}")
    return bus


def no_server(fleet: str) -> NotConnected:
    """The error that no map server answers."""
    return NotConnected(
        f"a router is up, but no map server of fleet {fleet} answers: start `mapweave server` or give --fleet"
    )
