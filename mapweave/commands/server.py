"""`mapweave server`: the map server, with the Zenoh router inside."""

from __future__ import annotations

import argparse
import logging
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mapweave.commands.map_input import SOURCES, opened
from mapweave.commands.network import (
    add_network,
    network_of,
    renew_access,
    router_settings,
    settings_of,
    stop_on_signals,
)

LARGE = 20_000_000
"""Bytes of a store whose reading is announced, since it takes long."""


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "server",
        help="run the map server and the router",
        description="Keep every robot's map, merge them, localize lost robots and give routes. "
        "The Zenoh router that robots connect to runs inside. With --http it also tells people where a "
        "photograph was taken, and why maps are one or are not: POST /relocalize, GET /explain, GET /status, "
        "and pages for phones at / and /why.",
    )
    parser.add_argument("--name", help="the server's name in the fleet (default: s0)")
    parser.add_argument("--data", type=Path, default=Path("out/server"), help="folder for the store")
    parser.add_argument(
        "--map", type=Path, metavar="FILE",
        help=f"a map that is there from the start, beside the store, and that robots join: {SOURCES}; it is "
        "read at each start and never changed",
    )  # fmt: skip
    parser.add_argument(
        "--lockstep", action="store_true", help="answer only what is merged already: repeatable simulation"
    )
    parser.add_argument(
        "--http", metavar="[HOST:]PORT",
        help="answer people over HTTP as well, on this machine alone unless HOST is given, "
        "for example 8080 or 0.0.0.0:8080 (default: off)",
    )  # fmt: skip
    parser.add_argument(
        "--http-commands", action="store_true",
        help="with --http: other machines may move robots, too; there is no password",
    )  # fmt: skip
    add_network(parser, listens=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve until stopped."""
    from mapweave.hybridmap.node import check_name
    from mapweave.mapserver.base_map import BaseMap
    from mapweave.mapserver.schedule import LiveSchedule, LockstepSchedule
    from mapweave.mapserver.server import MapServer, ServerSettings
    from mapweave.processes.service_manager import ServiceManager
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus

    # Lines have dates, so that a log shows when two maps came apart.
    logging.basicConfig(format="%(asctime)s %(message)s", datefmt="%Y-%m-%d %H:%M:%S")
    for part in ("mapweave.mapserver", "mapweave.wire"):
        logging.getLogger(part).setLevel(logging.INFO)
    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    name = check_name(arguments.name or network.server)
    router, folder = router_settings(network, name)
    keys = Keys(router.fleet)
    address = None
    if arguments.http is not None:
        from mapweave.mapserver.http.web import Web, parse_address

        address = parse_address(arguments.http)
    stop = stop_on_signals()
    bus = ZenohBus(router)
    try:
        how = ServerSettings(settings.admission_control, settings.merge)
        schedule = LockstepSchedule() if arguments.lockstep else LiveSchedule()
        with ExitStack() as stack:
            path = arguments.data / f"{name}.sqlite"
            if path.exists() and path.stat().st_size > LARGE:
                print(f"reading {path}, {path.stat().st_size / 1e6:.0f} MB ...", flush=True)
            base = None
            if arguments.map is not None:
                base = BaseMap.of(str(arguments.map), opened(arguments.map).content)
            server = MapServer(bus, keys, path, name, how, schedule, base)
            if base is not None:
                print(f"with {base}", flush=True)
            stack.enter_context(server)
            where = ", ".join(router.listen)
            print(f"map server {name} of fleet {keys.fleet} listens at {where}", flush=True)
            if address is not None:
                stack.enter_context(Web(address, server, commands=arguments.http_commands))
                print(f"for people: http://{':'.join(map(str, address))}/", flush=True)
            last_line, manager = "", ServiceManager()
            manager.ready()
            while not stop.wait(1.0):
                manager.alive()
                if folder is not None:
                    router = renew_access(bus, folder, router, name)
                now = server.summary()
                if now != last_line:
                    print(now, flush=True)
                    last_line = now
    finally:
        bus.close()
    return 0
