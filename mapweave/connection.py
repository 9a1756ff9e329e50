"""Connections of commands and programs that need a router or a server now, and what they say without one."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mapweave.hybridmap.errors import NotConnected
from mapweave.identities.validity import out_of_date
from mapweave.wire.credentials import Role

if TYPE_CHECKING:
    from mapweave.wire.bus import Bus
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.credentials import Credentials
    from mapweave.wire.keys import Keys
    from mapweave.wire.log_messages import Scalar
    from mapweave.wire.zenoh_bus import ZenohBus

SOON = 1.0
"""s; a router that is there is found sooner. Commands say within 2 s of their start that there is none."""
UNHEARD = 0.5
"""s; a router that opens again, as when keys change, listens sooner. If nothing listens at any endpoint,
commands wait no longer: on a slow computer loading takes the rest of the 2 s."""
LOOK = 0.2
"""s; without a router a person learns why in this time more."""
ANSWERED = 2.0
"""s; a server or robot that is there answers sooner."""


def reach(settings: BusSettings, advice: str = "give the endpoint of its router (--connect)") -> ZenohBus:
    """A connection of a client that needs a router now.

    Args:
        settings: of the client; the first endpoint in reach is taken.
        advice: what else a person can do.

    Raises:
        NotConnected: there is none.
    """
    from mapweave.wire.zenoh_bus import ZenohBus

    bus = ZenohBus(replace(settings, attempt=SOON / len(settings.endpoints)))
    if not found_soon(bus, settings):
        bus.close()
        where = ", ".join(settings.endpoints)
        refused = not_let_in(settings)
        raise NotConnected(f"no router at {where}: {refused or f'start `mapweave server`, or {advice}'}")
    return bus


def found_soon(bus: ZenohBus, settings: BusSettings) -> bool:
    """Wait until a connection is there, for less time where nothing listens; returns whether it is."""
    found = bus.wait_connected(UNHEARD)
    if not found and not all(map(_refused, settings.endpoints)):
        found = bus.wait_connected(SOON - UNHEARD)
    return found


def not_let_in(settings: BusSettings) -> str:
    """Why no router lets this in, and what to do; empty if the key is good and nothing listens there."""
    if old := out_of_date(settings.credentials):
        return old
    if not any(map(_listens, settings.endpoints)):
        return ""
    hint = _key_hint(settings.credentials, asked=False)
    hint = hint or "; if the fleet has keys, give a key file (--keys FILE)"
    if settings.credentials is not None and settings.credentials.certified:
        hint += "; or the router's certificate is for other names, those of `mapweave keys init --at`, has "
        hint += "expired, or is by another authority than this key, that of another `mapweave keys init`"
    return f"what listens there does not let this in{hint}"


def _listens(endpoint: str) -> bool:
    """Whether a program takes connections there."""
    try:
        _try(endpoint)
    except (OSError, ValueError):
        return False
    return True


def _refused(endpoint: str) -> bool:
    """Whether the computer there says that no program takes connections."""
    if endpoint.startswith("quic/"):
        return False
    try:
        _try(endpoint)
    except ConnectionRefusedError:
        return True
    except (OSError, ValueError):
        pass
    return False


def _try(endpoint: str) -> None:
    host, _, port = endpoint.partition("/")[2].partition("#")[0].partition("?")[0].rpartition(":")
    with socket.create_connection((host.strip("[]"), int(port)), LOOK):
        pass


def no_server(bus: Bus, keys: Keys, holder: Credentials | None = None) -> NotConnected:
    """The error that no map server answers: none is there, or one waits for its store.

    Args:
        bus: the connection.
        keys: of the fleet.
        holder: of the key with which one is connected, if there is one.
    """
    if waits := [waits_for(one) for one in server_statuses(bus, keys, ANSWERED) if waits_for(one)]:
        return NotConnected("; ".join(waits))
    return NotConnected(
        f"a router is up, but no map server of fleet {keys.fleet} answers: start `mapweave server` or give "
        "another fleet (--fleet)"
        f"{_key_hint(holder)}"
    )


def server_statuses(bus: Bus, keys: Keys, timeout: float) -> list[dict[str, Scalar]]:
    """What the map servers say of themselves, those that answer, also those that wait for their store."""
    from mapweave.wire.log_messages import decode_record

    replies = bus.ask(keys.server_statuses(), b"", timeout)
    return [decode_record(reply.payload) for reply in replies if not reply.error]


def waits_for(status: Mapping[str, Scalar]) -> str:
    """What a map server waits for before it serves, in words, by its status; empty if it serves."""
    return f"map server {status['name']} is {status['summary']}" if status.get("loading") else ""


def router_gone() -> NotConnected:
    """The error that a router which was there is in reach no more."""
    return NotConnected("the router is gone: start `mapweave server` there again")


def _key_hint(holder: Credentials | None, asked: bool = True) -> str:
    """A router drops what a key may not do, without a word; of no role it refuses the connection."""
    if holder is None:
        return ""
    if not asked:
        return (
            f"; or the key of {holder.name} was revoked or has expired: `mapweave keys list` at the server "
            "and the server's log say so"
        )
    if holder.role is Role.ROBOT:
        return (
            f"; or {holder.name} may not ask this: its key is a robot's, use a viewer's or an operator's; "
            "or it was revoked or has expired: `mapweave keys list` at the server and the server's log say so"
        )
    return (
        f"; or the key of {holder.name} was revoked, has expired or may not do this: `mapweave keys list` at "
        "the server and the server's log say so"
    )
