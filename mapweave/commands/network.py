"""Arguments and connections that several commands share."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

from mapweave.commands import values
from mapweave.connection import LOOK, SOON
from mapweave.hybridmap.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable

    from mapweave.identities.key_folder import KeyFolder
    from mapweave.identities.key_renewal import KeyRenewal
    from mapweave.identities.own_key import OwnKey
    from mapweave.settings import NetworkSettings, Settings
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.credentials import Credentials
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus

SETTLED = 2.0
"""s; a router that starts meanwhile has let its clients in by then."""
LOST = 10.0
"""s; after which a router that was there counts as lost."""


def add_network(parser: argparse.ArgumentParser, listens: bool = False) -> None:
    """Arguments with which a process finds its fleet."""
    group = parser.add_argument_group("network")
    group.add_argument(
        "--fleet", type=values.name, metavar="NAME", help="name that robots and server share (default: demo)",
    )  # fmt: skip
    if listens:
        group.add_argument(
            "--listen", nargs="+", type=values.endpoint, metavar="ENDPOINT", dest="endpoints",
            help="Zenoh endpoints to listen at (default: tcp/127.0.0.1:7447, or as the keys say)",
        )  # fmt: skip
        group.add_argument(
            "--connect", nargs="+", type=values.endpoint, metavar="ROUTER", dest="routers",
            help="another router to join, so that the robots of each reach the servers of both; a map server "
            "without --listen is a client of the first of these routers that is in reach (default: none)",
        )  # fmt: skip
    else:
        group.add_argument(
            "--connect", nargs="+", type=values.endpoint, metavar="ENDPOINT", dest="endpoints",
            help="Zenoh endpoints of routers; the first in reach is taken, and the next one when it fails "
            "(default: tcp/127.0.0.1:7447, or as the key says)",
        )  # fmt: skip
    what = "folder of `mapweave keys init`" if listens else "key file of `mapweave keys add`"
    group.add_argument("--keys", type=values.given, metavar="FOLDER" if listens else "FILE", help=what)
    parser.set_defaults(listens=listens)
    parser.add_argument("--settings", type=Path, metavar="FILE", help="TOML; the command line overrides it")


def add_log_format(parser: argparse.ArgumentParser) -> None:
    """How a process that runs on writes its log."""
    parser.add_argument(
        "--log-format", choices=["text", "json"], default="text",
        help="lines of the log: words, or one JSON object each (default: text)",
    )  # fmt: skip


def add_timeout(parser: argparse.ArgumentParser, default: float = 20.0, of: str = "an answer") -> None:
    """How long a command waits."""
    parser.add_argument(
        "--timeout", type=values.seconds, default=default, metavar="S",
        help=f"longest wait for {of} (default: {default:g})",
    )  # fmt: skip


def add_author(parser: argparse.ArgumentParser) -> None:
    """Who gives an order or changes a record."""
    parser.add_argument(
        "--by", type=values.remark, default="", metavar="NAME", help="your name (default: the login name)"
    )


def add_reason(parser: argparse.ArgumentParser) -> None:
    """Why a record is changed, and who does."""
    parser.add_argument(
        "--because", type=values.remark, default="", metavar="TEXT", help="why; for those who wonder later"
    )
    add_author(parser)


def settings_of(arguments: argparse.Namespace) -> Settings:
    """The settings file with the command line over it."""
    from mapweave.settings import load_settings

    return load_settings(arguments.settings)


def network_of(arguments: argparse.Namespace, settings: Settings, name: str = "") -> NetworkSettings:
    """Where the fleet is: the command line over the key file over the settings.

    Args:
        arguments: of the command line.
        settings: of the settings file.
        name: of the robot whose key it must be.

    Raises:
        SettingsError: the key file is missing or damaged, or of another fleet or robot.
    """
    from mapweave.identities.key_file import read_key_file
    from mapweave.settings import NetworkSettings

    given, keys = settings.network, arguments.keys or settings.network.keys
    fleet, endpoints = arguments.fleet or given.fleet, given.endpoints
    if keys and not arguments.listens:
        key, default = read_key_file(Path(keys)), NetworkSettings()
        owner = key.credentials.name
        if fleet not in (default.fleet, key.fleet):
            raise SettingsError(f"{keys} is a key of fleet {key.fleet}, not of {fleet}")
        if name and name != owner:
            raise SettingsError(
                f"{keys} is the key of {owner}, not of {name}: give that of {name}, which "
                f"`mapweave keys add {name}` at the server makes"
            )
        fleet, endpoints = key.fleet, key.endpoints if endpoints == default.endpoints else endpoints
    if arguments.endpoints:
        endpoints = tuple(arguments.endpoints)
    routers = tuple(arguments.routers or given.routers) if arguments.listens else ()
    return NetworkSettings(fleet, endpoints, routers, given.server, keys)


def keep_files_private(network: NetworkSettings) -> None:
    """Let this process make files and folders that other users of the machine cannot read, if there are keys.

    They hold the map and images of the building, and keys say who may see these.
    """
    if network.keys:
        os.umask(os.umask(0o077) | 0o077)


def simulator_beside(network: NetworkSettings) -> str:
    """Why a simulator cannot take part in a fleet with keys, and what to do, in one line."""
    return (
        "a router with keys admits no simulator, which speaks for several robots: serve their bodies beside "
        f"it with `mapweave sim serve SCENARIO --fleet {network.fleet} --listen tcp/127.0.0.1:7448`, and "
        "start each agent with its key and --body tcp/127.0.0.1:7448"
    )


def connect(network: NetworkSettings) -> tuple[ZenohBus, Keys]:
    """An agent's connection; it opens in the background and survives a router that comes and goes."""
    from mapweave.wire.bus_settings import AGENT_LEASE
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus

    return ZenohBus(replace(client_settings(network), lease=AGENT_LEASE)), Keys(network.fleet)


def client_settings(network: NetworkSettings) -> BusSettings:
    """How a client connects."""
    from mapweave.wire.bus_settings import BusSettings

    return BusSettings(mode="client", endpoints=network.endpoints, credentials=key_holder(network))


def key_holder(network: NetworkSettings) -> Credentials | None:
    """Whose key a client has; None without one."""
    from mapweave.identities.key_file import read_key_file

    return read_key_file(Path(network.keys)).credentials if network.keys else None


def router_settings(network: NetworkSettings, server: str) -> tuple[BusSettings, KeyFolder | None]:
    """How a router listens: with the fleet's keys, or on this machine alone.

    Args:
        network: where to listen, and the folder of the keys.
        server: name of the map server whose key the router has.

    Raises:
        SettingsError: there are no keys in the folder, or none of this server.
    """
    from mapweave.identities.key_folder import KeyFolder
    from mapweave.settings import NetworkSettings
    from mapweave.wire.bus_settings import BusSettings

    if not network.keys:
        return BusSettings(
            mode="router", listen=network.endpoints, routers=network.routers, fleet=network.fleet
        ), None
    folder, default = KeyFolder(Path(network.keys)), NetworkSettings()
    fleet = folder.catalogue.fleet
    if network.fleet not in (default.fleet, fleet):
        raise SettingsError(f"{network.keys} has the keys of fleet {fleet}, not of {network.fleet}")
    listen = () if network.endpoints == default.endpoints else network.endpoints
    return folder.router(server, listen, network.routers), folder


def server_settings(network: NetworkSettings, server: str) -> tuple[BusSettings, KeyFolder | None]:
    """How a map server takes part: as a router, or, given routers but not where to listen, as their client.

    Raises:
        SettingsError: see `router_settings`.
    """
    from mapweave.identities.key_file import read_key_file
    from mapweave.settings import NetworkSettings
    from mapweave.wire.bus_settings import BusSettings

    if not network.routers or network.endpoints != NetworkSettings().endpoints:
        return router_settings(network, server)
    settings, folder = router_settings(replace(network, routers=()), server)
    own = None if folder is None else read_key_file(folder.key_file(server)).credentials
    return BusSettings(endpoints=network.routers, credentials=own, fleet=settings.fleet), folder


def key_renewal(
    bus: ZenohBus,
    folder: KeyFolder | None,
    server: str,
    settings: BusSettings,
    renewed: Callable[[Credentials], None] = lambda credentials: None,
) -> KeyRenewal | None:
    """What keeps a router's rules up to date, if it has keys; it says on stderr what it does."""
    from mapweave.identities.key_renewal import KeyRenewal
    from mapweave.terminal import stamped

    if folder is None:
        return None

    def say(line: str) -> None:
        print(stamped(line), file=sys.stderr, flush=True)

    return KeyRenewal(bus, folder, server, settings, say, renewed)


def own_key(bus: ZenohBus, network: NetworkSettings, name: str) -> OwnKey | None:
    """Lets an agent go on when its key file, if it has one, is replaced; says on stderr what it does."""
    from mapweave.identities.own_key import OwnKey
    from mapweave.terminal import stamped

    holder = key_holder(network)
    if holder is None:
        return None

    def say(line: str) -> None:
        print(stamped(f"{name}: {line}"), file=sys.stderr, flush=True)

    return OwnKey(bus, Path(network.keys), holder, say)


def reach(network: NetworkSettings, advice: str = "give --connect") -> tuple[ZenohBus, Keys]:
    """A client connection of a command that needs a router now.

    Raises:
        NotConnected: there is none; one line says what to do.
    """
    from mapweave import connection
    from mapweave.wire.keys import Keys

    return connection.reach(client_settings(network), advice), Keys(network.fleet)


def warn_without_router(bus: ZenohBus, name: str, settings: BusSettings, since: float | None = None) -> None:
    """Say on stderr if no router is reached soon or for long, and when one is found then; does not wait.

    A router that is only restarted is not reported.

    Args:
        bus: the connection.
        name: who looks for a router.
        settings: of the connection.
        since: when it was opened, by `time.monotonic`; None: now.
    """
    from mapweave.connection import not_let_in
    from mapweave.terminal import stamped

    where = ", ".join(settings.endpoints)
    opened = time.monotonic() if since is None else since

    def say(words: str) -> None:
        print(stamped(f"{name} {words}"), file=sys.stderr, flush=True)

    def look() -> None:
        patience, since = SOON, opened
        while not bus.closed:
            if bus.connected():
                patience, since = LOST, time.monotonic()
            # A process that ends earlier has not waited long enough to know.
            elif time.monotonic() - since >= patience:
                advice = not_let_in(settings)
                # What has begun to listen a moment ago lets this in a moment later.
                if advice and bus.wait_connected(SETTLED):
                    continue
                advice = advice or "start `mapweave server` or `mapweave router`, or give --connect"
                say(f"finds no router at {where}: {advice}; it goes on looking")
                while not bus.connected() and not bus.closed:
                    time.sleep(LOOK)
                if not bus.closed:
                    say("has found a router")
            time.sleep(LOOK)

    threading.Thread(target=look, name="router", daemon=True).start()


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM, Ctrl-C, the end of the terminal or of a parent set: a process can end in order.

    A process that `nohup` has started outlasts its terminal, and so does a job that its shell has disowned.
    """
    from mapweave import early_interrupt
    from mapweave.lost_terminal import outlast_terminal
    from mapweave.processes import parent_watchdog

    outlast_terminal()
    stop, came = threading.Event(), SimpleQueue[int]()
    parent_watchdog.hold(stop)
    terminals = [number for number in (1, 2) if os.isatty(number)]

    def hang_up(signum: int, _: object) -> None:
        # What libraries write beside Python's streams, as FFmpeg does, fails on a terminal that is gone.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for number in terminals:
            os.dup2(nowhere, number)
        came.put(signum)

    def wait() -> None:
        came.get()
        stop.set()

    # A handler runs amid whatever the main thread does, which may hold the event's lock: it would wait for
    # itself. So another thread sets it; a SimpleQueue may be filled at any time.
    threading.Thread(target=wait, name="signals", daemon=True).start()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: came.put(signum))
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, hang_up)
    if early_interrupt.came():
        stop.set()
    return stop
