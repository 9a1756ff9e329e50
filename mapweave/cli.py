"""The command line: `mapweave COMMAND`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from mapweave.commands import (
    agent,
    calibrate,
    closures,
    demo,
    doctor,
    drive,
    evaluate,
    find_cameras,
    find_port,
    info,
    keys,
    map_file,
    missions,
    open_map,
    place,
    record,
    relocalize,
    replay,
    robots,
    router,
    server,
    settings,
    sim,
    status,
)
from mapweave.extras import MissingExtra, extra_of
from mapweave.hybridmap.errors import MapweaveError

EPILOG = "Start with `mapweave demo`. Each command has its own --help."
MISSING_EXTRA = 3
"""Exit status of a command whose libraries are not installed."""


class CommandParser(argparse.ArgumentParser):
    """A parser whose arguments name the command that was given, as `command`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Make a parser; those of its commands are of this class, too."""
        super().__init__(*args, **kwargs)
        self.set_defaults(command=self.prog)


class PrintVersion(argparse.Action):
    """Print the version and exit; it is looked up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it."""
        from importlib.metadata import version

        print(f"mapweave {version('mapweave')}")
        parser.exit()


def parser() -> argparse.ArgumentParser:
    """All commands with their arguments."""
    top = CommandParser(
        prog="mapweave",
        description="Small robots with one camera each map a building together over Zenoh.",
        epilog=EPILOG,
    )
    top.add_argument("--version", nargs=0, action=PrintVersion, help="print the version and exit")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (
        demo, server, router, sim, agent, drive, status, missions, place, closures, keys, robots, doctor,
        find_port, find_cameras, calibrate, map_file, open_map, record, replay, info, relocalize, evaluate,
        settings,
    ):  # fmt: skip
        command.add_to(commands)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        0 if it did what was asked, 1 if it could not (one line on stderr says why), 3 if it needs an extra
        that is not installed, 130 if interrupted. What 2 means is in the command's own help.
    """
    arguments = parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
    except MissingExtra as error:
        print(f"{arguments.command} {error}", file=sys.stderr)
        return MISSING_EXTRA
    except ModuleNotFoundError as error:
        extra = extra_of(error.name)
        if extra is None:
            raise
        print(f"{arguments.command} {MissingExtra([extra])}", file=sys.stderr)
        return MISSING_EXTRA
    except MapweaveError as error:
        print(f"mapweave: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("mapweave: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 1
    except OSError as error:
        # A disk that is full, a folder that may not be written: the system's words say it best, but for one.
        reason = error.strerror or error
        if isinstance(error, FileExistsError):
            reason = "is a file; give a folder, or a place where one can be made"
        elif isinstance(error, NotADirectoryError):
            reason = "cannot be made: what it should be in is a file"
        where = f"{error.filename}: " if error.filename else ""
        print(f"mapweave: {where}{reason}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
