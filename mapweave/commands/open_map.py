"""`mapweave open`: the map server's page for a map file, a store or a journal, without robots."""

import argparse
from pathlib import Path
from typing import Any

from mapweave.commands import values
from mapweave.commands.map_input import SOURCES, map_source, merged_with_progress, opened
from mapweave.commands.network import settings_of, stop_on_signals


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "open",
        help="show a map in the browser, without robots",
        description="Serve the map server's page for a map file, a server's store or an agent's journal: "
        "`mapweave open office.mapweave`, then open the address that is printed. The map is only shown: "
        "neither the file nor its folder is ever changed, and there are no robots to send.",
    )
    parser.add_argument("file", type=map_source, metavar="FILE", help=SOURCES)
    parser.add_argument(
        "--http", type=values.given, metavar="[HOST:]PORT", default="8080",
        help="where; 0 takes a free port; with --keys people log in, and 0.0.0.0:8080 serves other machines, "
        "too (default: 8080)",
    )  # fmt: skip
    parser.add_argument("--keys", type=Path, metavar="FOLDER", help="folder of `mapweave keys init`")
    parser.add_argument("--settings", type=Path, metavar="FILE", help="TOML; [merge] says how it was merged")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve until stopped."""
    from mapweave.commands.http_access import http_access
    from mapweave.identities.key_folder import KeyFolder
    from mapweave.read_only_server import ReadOnlyServer

    folder, settings = None if arguments.keys is None else KeyFolder(arguments.keys), settings_of(arguments)
    people = http_access(arguments.http, folder, settings.network.server)
    one = opened(arguments.file)
    merged = merged_with_progress(one, settings.merge)
    stop = stop_on_signals()
    with ReadOnlyServer(one, merged, settings.merge) as server, people.serve(server) as page:
        print(f"{one.path}: {merged.summary()}", flush=True)
        print(f"open {people.url(page.port)} to see it; Ctrl-C ends", flush=True)
        stop.wait()
    return 0
