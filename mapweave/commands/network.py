"""Arguments and connections that several commands share."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mapweave.settings import NetworkSettings, Settings
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus

SOON = 1.0
"""s; a router that is there is found sooner. As `mapweave.fleet.SOON`, which an agent does not import."""


def add_network(parser: argparse.ArgumentParser, listens: bool = False) -> None:
    """Arguments with which a process finds its fleet."""
    group = parser.add_argument_group("network")
    group.add_argument("--fleet", metavar="NAME", help="name that robots and server share (default: demo)")
    word = "listen at" if listens else "connect to"
    group.add_argument(
        f"--{'listen' if listens else 'connect'}",
        metavar="ENDPOINT",
        dest="endpoint",
        help=f"Zenoh endpoint to {word} (default: tcp/127.0.0.1:7447)",
    )
    parser.add_argument("--settings", type=Path, metavar="FILE", help="TOML; the command line overrides it")


def settings_of(arguments: argparse.Namespace) -> Settings:
    """The settings file with the command line over it."""
    from mapweave.settings import load_settings

    return load_settings(arguments.settings)


def network_of(arguments: argparse.Namespace, settings: Settings) -> NetworkSettings:
    """Where the fleet is: the command line over the settings."""
    from mapweave.settings import NetworkSettings

    given = settings.network
    return NetworkSettings(
        fleet=arguments.fleet or given.fleet,
        endpoints=(arguments.endpoint,) if arguments.endpoint else given.endpoints,
        server=given.server,
    )


def connect(network: NetworkSettings) -> tuple[ZenohBus, Keys]:
    """A client connection; it opens in the background and survives a router that comes and goes."""
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus

    return ZenohBus(BusSettings(mode="client", endpoints=network.endpoints)), Keys(network.fleet)


def reach(network: NetworkSettings, advice: str = "give --connect") -> tuple[ZenohBus, Keys]:
    """A client connection of a command that needs a router now.

    Raises:
        NotConnected: there is none; one line says what to do.
    """
    from mapweave import fleet
    from mapweave.wire.keys import Keys

    return fleet.reach(network.endpoints, advice), Keys(network.fleet)


def warn_without_router(bus: ZenohBus, name: str) -> None:
    """Warn on stderr if no router is reached soon; does not wait."""
    from mapweave.terminal import stamped

    began = time.monotonic()

    def look() -> None:
        # A process that ends earlier has not waited long enough to know.
        if not bus.wait_connected(SOON) and time.monotonic() - began >= SOON:
            advice = "start `mapweave server` or `mapweave router`, or give --connect"
            line = stamped(f"{name} finds no router: {advice}; it goes on looking")
            print(line, file=sys.stderr, flush=True)

    threading.Thread(target=look, name="router", daemon=True).start()


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM, Ctrl-C and a parent's end set, so that a process can end in order."""
    from mapweave.processes import parent_watchdog

    stop = threading.Event()
    parent_watchdog.hold(stop)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop
