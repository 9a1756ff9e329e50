"""`mapweave server`: the map server, with the Zenoh router inside."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import shutil
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.map_input import SOURCES, map_source, opened
from mapweave.commands.network import (
    add_log_format,
    add_network,
    keep_files_private,
    key_renewal,
    network_of,
    server_settings,
    settings_of,
    stop_on_signals,
    warn_without_router,
)
from mapweave.commands.usage import UsageError
from mapweave.connection import SOON
from mapweave.extras import need
from mapweave.hybridmap.errors import InvalidFile

if TYPE_CHECKING:
    from mapweave.mapserver.server import MapServer

DATA = Path("out/server")
DEMO_HTTP = "8080"
TURN = 0.001
"""s, for which a thread has the interpreter while another waits. A question lets go of it twenty times, and
waited 5 ms for the merge each time, which is Python's own."""
REMOVALS = 10
"""How often the files of a demo are removed that ends amid its start, while they are still being made."""
STORE_WAIT = 600.0
"""s: a PostgreSQL that was killed replays its log before it takes sessions."""
STOPPED = "stopped while it was starting"
LARGE = 20_000_000
"""Bytes of a store whose reading is announced, since it takes long."""


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "server",
        help="run the map server and the router",
        description="Keep every robot's map, merge them, localize lost robots and give routes. "
        "The Zenoh router that robots connect to runs inside. With --http it also serves a page: the merged "
        "map and its robots live, where a photograph was taken, and why maps are one or are not.",
    )
    parser.add_argument("--name", type=values.name, help="the server's name in the fleet (default: s0)")
    parser.add_argument("--data", type=Path, help=f"folder for the store (default: {DATA})")
    parser.add_argument(
        "--store", metavar="postgresql://...",
        help="a PostgreSQL database for the store, which several servers may share; --data is then the "
        "folder for what can be computed again. A password belongs in ~/.pgpass (default: a file in --data)",
    )  # fmt: skip
    parser.add_argument(
        "--store-wait", type=values.seconds, default=STORE_WAIT, metavar="S",
        help="longest wait at the start for that database, where it is not up yet (default: "
        f"{STORE_WAIT:g})",
    )  # fmt: skip
    parser.add_argument(
        "--demo", action="store_true",
        help="show a recorded fleet whose robots move, without any robot; nothing is kept, and the page is "
        "at http://127.0.0.1:8080/ unless --http says otherwise",
    )  # fmt: skip
    parser.add_argument(
        "--map", type=map_source, metavar="FILE",
        help=f"a map that is there from the start, beside the store, and that robots join: {SOURCES}; it is "
        "read at each start and never changed",
    )  # fmt: skip
    parser.add_argument(
        "--lockstep", action="store_true", help="answer only what is merged already: repeatable simulation"
    )
    parser.add_argument(
        "--http", type=values.given, metavar="[HOST:]PORT",
        help="answer people over HTTP as well, for example 8080; 0 takes a free port and prints it; with "
        "--keys people log in, over HTTPS, and 0.0.0.0:8080 serves other machines, too (default: off)",
    )  # fmt: skip
    parser.add_argument(
        "--ray", metavar="auto|ADDRESS",
        help="split the place index among the processes of a Ray cluster, which also compare nodes: its "
        "address, or auto for the one that runs on this machine, which is started if there is none (default: "
        "off)",
    )  # fmt: skip
    add_log_format(parser)
    add_network(parser, listens=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve until stopped."""
    # What is wrong on the command line is said before anything is loaded for a second.
    if arguments.demo and (arguments.data is not None or arguments.store is not None):
        raise UsageError("--demo keeps nothing: leave out --data and --store")
    if arguments.store is not None:
        from mapweave.mapserver.log.opening import is_postgres

        if not is_postgres(arguments.store):
            raise UsageError(
                f"--store {arguments.store}: give a PostgreSQL address, postgresql://USER@HOST/DATABASE; "
                "a file needs no --store: it is in the folder of --data"
            )
    need("server")

    # Modules stay: looking among them for garbage took a sixth of the start.
    gc.disable()
    from mapweave.hybridmap.ids import check_name
    from mapweave.terminal import log_with_time, stamped

    # Lines have dates, so that a log shows when two maps came apart.
    log_with_time(arguments.log_format)
    sys.setswitchinterval(TURN)
    for part in ("mapweave.mapserver", "mapweave.wire", "mapweave.processes"):
        logging.getLogger(part).setLevel(logging.INFO)
    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    keep_files_private(network)
    name = check_name(arguments.name or network.server)
    router, folder = server_settings(network, name)
    cluster = replace(settings.cluster, ray=arguments.ray or settings.cluster.ray)
    if cluster.ray and arguments.lockstep:
        raise UsageError("--lockstep is repeatable, and a cluster is not: leave out one of them")
    if cluster.ray:
        need("cluster")
    stop = stop_on_signals()
    with ExitStack() as stack:
        data, web = arguments.data or DATA, None
        if arguments.demo:
            data = Path(stack.enter_context(TemporaryDirectory()))
        path = data / f"{name}.sqlite"
        people, http = None, arguments.http or (DEMO_HTTP if arguments.demo else None)
        if http is not None:
            from mapweave.commands.http_access import http_access
            from mapweave.mapserver.http.last_shown import SUFFIX, read_shown, write_shown
            from mapweave.mapserver.http.loading import LoadingServer
            from mapweave.recorded_fleet.recording import DEMO_PAGE

            people, loading = http_access(http, folder, name), LoadingServer()
            shown = path.with_name(path.name + SUFFIX)
            before = read_shown(DEMO_PAGE if arguments.demo else shown)
            web = people.serve(loading, before)
            stack.enter_context(web)
            print(stamped(f"for people: {people.url(web.port)}"), flush=True)

        # The page is there: a browser can open it while all else is loaded. Whether another server has this
        # name takes a third of a second to find out, and what is loaded meanwhile takes longer.
        from mapweave.processes.server_name import NameWatch, refuse_second
        from mapweave.wire.keys import Keys
        from mapweave.wire.zenoh_bus import ZenohBus
        from mapweave.wire.zenoh_log import ZenohLog

        if folder is not None:
            stack.enter_context(ZenohLog())
        keys, bus = Keys(router.fleet), ZenohBus(router)
        stack.callback(bus.close)

        def look_for_another() -> None:
            if router.mode == "client" or router.routers:
                bus.wait_connected(SOON)
                refuse_second(bus, keys, name)

        looking = stack.enter_context(ThreadPoolExecutor(1, "server name")).submit(look_for_another)
        from mapweave.mapserver.base_map import BaseMap
        from mapweave.mapserver.merging.merge_surroundings import MergeSurroundings
        from mapweave.mapserver.schedule import LiveSchedule, LockstepSchedule, Schedule
        from mapweave.mapserver.server import MapServer, ServerSettings
        from mapweave.processes.separate_stores import SeparateStores
        from mapweave.processes.service_manager import ServiceManager
        from mapweave.processes.store_wait import Waiting, WaitingServer, made_with_store

        gc.freeze()
        gc.enable()
        looking.result()
        how = ServerSettings(
            settings.admission_control, settings.merge, settings.quotas, cluster, settings.attendance
        )
        if arguments.demo:
            from mapweave.recorded_fleet.fleet import RecordedFleet, prepare

            prepare(data, path, before)
        if arguments.store is None and path.exists() and path.stat().st_size > LARGE:
            print(stamped(f"reading {path}, {path.stat().st_size / 1e6:.0f} MB ..."), flush=True)
        if arguments.store is None and not path.exists() and (beside := _stores_beside(path)):
            # As after a restore under another name, or with another --name than before.
            print(
                stamped(
                    f"{path} is a new store, with nothing in it: a server goes on with that of its own "
                    f"--name, and not with {', '.join(beside)} beside it"
                ),
                flush=True,
            )
        base = None
        if arguments.map is not None:
            given = opened(arguments.map)
            base = BaseMap.of(str(given.path), given.content)

        def make() -> MapServer:
            schedule: Schedule = LiveSchedule()
            surroundings = MergeSurroundings.live
            if arguments.lockstep:
                schedule, surroundings = LockstepSchedule(), MergeSurroundings.repeatable
            return MapServer(
                bus, keys, arguments.store or path, name, how, schedule, base, data, surroundings
            )

        def tell(words: str) -> None:
            print(stamped(words), flush=True)

        def may_help() -> bool:
            from mapweave.storage.postgres_reachability import waiting_may_help
            from mapweave.storage.postgres_session import PostgresAddress

            return waiting_may_help(PostgresAddress.read(arguments.store))

        waits = WaitingServer(bus, keys, name)
        stack.callback(waits.close)

        def show(words: str) -> None:
            waits.show(words)
            if web is not None:
                loading.wait(words)

        waiting = Waiting(tell, show)
        server = made_with_store(make, may_help, waiting, stop, arguments.store_wait)
        if server is None:
            tell(STOPPED)
            return 0
        if base is not None:
            print(stamped(f"with {base}"), flush=True)
        started = end_if_stopped_before(
            stop, data if arguments.demo else None, web.close if web is not None else None
        )
        stack.enter_context(server)
        started.set()
        if not arguments.lockstep:
            stack.callback(NameWatch(bus, keys, name).close)
            if arguments.store is None:
                stack.callback(SeparateStores(bus, keys, name).close)
        if web is not None:
            loading.take(server)
            stack.callback(lambda: write_shown(shown, web.shown()))
            # The page ends first: it asks the server.
            stack.callback(web.close)
        where = "listens at " + ", ".join(router.listen)
        if router.mode == "client":
            where = "is at the routers " + ", ".join(router.endpoints)
            warn_without_router(bus, name, router)
        print(stamped(f"map server {name} of fleet {keys.fleet} {where}"), flush=True)
        if arguments.demo:
            stack.enter_context(RecordedFleet(bus, keys, name, data))
        renewed = people.renew if people is not None else lambda own: None
        renewal = key_renewal(bus, folder, name, router, renewed)
        last_line, manager = "", ServiceManager()
        manager.ready()
        while not stop.wait(1.0):
            manager.alive()
            if ends := server.displaced or server.broken:
                raise InvalidFile(ends)
            if renewal is not None:
                renewal.check()
            now = summary_of(server)
            if now != last_line:
                print(stamped(now), flush=True)
                last_line = now
    return 0


def summary_of(server: MapServer) -> str:
    """One line for the log; after a start maps lie apart, without a link, until the first merge is done."""
    status = server.status()
    return str(status["summary"]) + ("" if status["merged"] or not status["nodes"] else ", still merging")


def _stores_beside(path: Path) -> list[str]:
    """Names of other servers' stores in the same folder."""
    from mapweave.opened_map import MapSource, source_of

    names = []
    for other in sorted(path.parent.glob("*.sqlite")):
        with suppress(InvalidFile):
            if source_of(other, live=True) is MapSource.STORE:
                names.append(other.name)
    return names


def end_if_stopped_before(
    stop: threading.Event, temporary: Path | None = None, close: Callable[[], None] | None = None
) -> threading.Event:
    """End the process on this event as long as the returned one is not set.

    A server reads its store at the start, which takes a minute for 100 000 places. Nothing is lost: what it
    writes meanwhile can be made again, and is written in transactions or whole files.

    Args:
        stop: set by signals.
        temporary: a folder that is removed then.
        close: ends the page, which answers while the server loads: else an answer may be cut off.
    """
    started = threading.Event()

    def wait() -> None:
        stop.wait()
        if not started.is_set():
            from mapweave.terminal import stamped

            print(stamped(STOPPED), flush=True)
            if close is not None:
                close()
            if started.is_set():  # meanwhile: it ends by itself
                return
            # The server goes on writing until the process ends.
            if temporary is not None:
                for _ in range(REMOVALS):
                    shutil.rmtree(temporary, ignore_errors=True)
            os._exit(0)

    threading.Thread(target=wait, name="start", daemon=True).start()
    return started
