"""The network: whether the router can be reached, and whether the fleet's map server answers."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.doctor.finding import Finding, good, warning, wrong

if TYPE_CHECKING:
    from mapweave.settings import NetworkSettings
    from mapweave.wire.zenoh_bus import ZenohBus

SUBJECT = "server"
PATIENCE = 1.5
"""s for a connection, and for an answer; what is there answers sooner."""


def examine(network: NetworkSettings) -> Iterator[Finding]:
    """Knock at each endpoint, then ask the map server how it is."""
    from mapweave.identities.key_file import read_key_file
    from mapweave.identities.validity import out_of_date
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.zenoh_bus import ZenohBus

    refusals = [refusal for endpoint in network.endpoints if (refusal := _refusal(endpoint))]
    if len(refusals) == len(network.endpoints):
        yield wrong(
            SUBJECT, "; ".join(refusals),
            "start `mapweave server` or `mapweave router` there, or give --connect; --offline skips it",
        )  # fmt: skip
        return
    credentials = read_key_file(Path(network.keys)).credentials if network.keys else None
    if old := out_of_date(credentials):
        reason, _, advice = old.partition(": ")
        yield wrong(SUBJECT, reason, advice)
        return
    attempt = PATIENCE / len(network.endpoints)
    bus = ZenohBus(BusSettings(endpoints=network.endpoints, credentials=credentials, attempt=attempt))
    try:
        if not bus.wait_connected(PATIENCE):
            yield wrong(
                SUBJECT, f"something listens at {', '.join(network.endpoints)} that is no Zenoh router"
                + (", or it refuses this key" if network.keys else ""),
                "give the endpoint of `mapweave server` with --connect, and the robot's key file with --keys",
            )  # fmt: skip
            return
        yield _answer(bus, network)
    finally:
        bus.close()


def _refusal(endpoint: str) -> str:
    """Why nothing can be reached at an endpoint; empty if something listens, or if it is no TCP."""
    found = re.match(r"(?:tcp|tls|ws)/\[?([^\]]*)\]?:(\d+)", endpoint)
    if found is None:
        return ""
    try:
        socket.create_connection((found[1], int(found[2])), PATIENCE).close()
    except OSError as error:
        return f"{endpoint}: {(error.strerror or str(error)).lower()}"
    return ""


def _answer(bus: ZenohBus, network: NetworkSettings) -> Finding:
    """What the fleet's server says of itself."""
    from mapweave.connection import waits_for
    from mapweave.wire.keys import Keys
    from mapweave.wire.log_messages import decode_record

    keys = Keys(network.fleet)
    for reply in bus.ask(keys.server_status(network.server), b"", PATIENCE):
        if reply.error:
            return wrong(SUBJECT, f"{network.server} refuses: {reply.error}", "see the server's log")
        record, own = decode_record(reply.payload), version("mapweave")
        theirs = str(record.get("version", "unknown"))
        if waits := waits_for(record):
            return wrong(SUBJECT, waits, "it serves once its store is there; see its log")
        words = f"{network.server} of fleet {network.fleet}, version {theirs}: {record.get('summary', '')}"
        if theirs != own:
            return warning(SUBJECT, words, f"this robot has version {own}; install the same on both")
        return good(SUBJECT, words)
    others = _servers(bus)
    if others:
        there = ", ".join(f"{name} of fleet {fleet}" for fleet, name in others)
        return wrong(
            SUBJECT, f"no server {network.server} of fleet {network.fleet}; there is {there}",
            "give the same --fleet, or [network] fleet and server, on robot and server",
        )  # fmt: skip
    return wrong(
        SUBJECT, f"the router answers, and no map server of fleet {network.fleet}",
        "start `mapweave server`; with a key, `mapweave keys list` there says whether it is good; a robot "
        "alone needs none: --offline leaves this out",
    )  # fmt: skip


def _servers(bus: ZenohBus) -> list[tuple[str, str]]:
    """(fleet, name) of every map server that the router knows."""
    found: set[tuple[str, str]] = set()
    heard = threading.Event()

    def see(key: str, alive: bool) -> None:
        parts = key.split("/")
        if alive and len(parts) == 6:
            found.add((parts[2], parts[4]))
            heard.set()

    watch = bus.watch("mapweave/*/*/server/*/alive", see)
    heard.wait(PATIENCE / 3)
    watch.close()
    return sorted(found)
