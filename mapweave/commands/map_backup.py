"""`mapweave map backup`: a copy of a server's store, also while the server runs."""

import argparse
from pathlib import Path
from typing import Any

from mapweave.commands.answer import add_json, print_said
from mapweave.commands.map_input import map_source
from mapweave.commands.usage import UsageError
from mapweave.hybridmap.errors import InvalidFile


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "backup",
        help="copy a server's store, also while the server runs",
        description="Copy a server's store on this machine into another file: "
        "`mapweave map backup out/server/s0.sqlite -o backup/monday.sqlite`. The server may run and goes on "
        "storing; the copy has everything that it acknowledged before the backup began, people's decisions "
        "and the images of floor plans (in FILE.plans). The copy is checked. A file that is there already "
        "is never written over. To restore, end the server, move its folder away, and start it with the "
        "copy under the name of the store in a new one: robots send what is newer. A "
        "store in PostgreSQL is backed up with pg_dump.",
    )
    parser.add_argument("source", type=map_source, metavar="STORE", help="of the server: NAME.sqlite")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="the copy")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Copy it, and say how large it is."""
    from mapweave.mapserver.store_backup import back_up
    from mapweave.opened_map import MapSource, source_of
    from mapweave.storage.database_copy import check_new
    from mapweave.terminal import working

    source, out = arguments.source, arguments.out
    if isinstance(source, str):
        raise UsageError("a store in PostgreSQL is backed up with pg_dump: see docs/operations.md")
    check_new(out)
    if (kind := source_of(source, live=True)) is not MapSource.STORE:
        # A robot that went on from an old journal would give numbers to changes that others have.
        raise InvalidFile(f"{source}: is a {kind.value.split()[-1]}, not a server's store")
    with working("copying pages") as bar:
        back_up(source, out, lambda done, of: bar.update(done, "", of))
    size = out.stat().st_size
    print_said(arguments, f"{out}: copy of the store, {size / 1e6:.1f} MB", file=str(out), bytes=size)
    return 0
