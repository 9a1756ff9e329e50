"""The command line: `mapweave COMMAND`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from hybridmap.errors import MapweaveError
from mapweave.commands import agent, demo, evaluate, map_file, relocalize, replay, server, sim

EPILOG = "Start with `mapweave demo`. Each command has its own --help."


def parser() -> argparse.ArgumentParser:
    """All commands with their arguments."""
    top = argparse.ArgumentParser(
        prog="mapweave",
        description="Small robots with one camera each map a building together over Zenoh.",
        epilog=EPILOG,
    )
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (demo, server, sim, agent, map_file, replay, relocalize, evaluate):
        command.add_to(commands)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        0 if it did what was asked, 1 if it could not (one line on stderr says why), 130 if interrupted.
    """
    arguments = parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
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
        what = error.strerror or error
        if isinstance(error, FileExistsError):
            what = "is a file; give a folder, or a place where one can be made"
        elif isinstance(error, NotADirectoryError):
            what = "cannot be made: what it should be in is a file"
        where = f"{error.filename}: " if error.filename else ""
        print(f"mapweave: {where}{what}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
