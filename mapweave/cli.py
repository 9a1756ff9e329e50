"""The command line: `mapweave COMMAND`."""

import argparse
import logging
import os
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any, NoReturn

from mapweave.commands import (
    agent,
    calibrate,
    closures,
    completion,
    demo,
    doctor,
    drive,
    evaluate,
    find_cameras,
    find_port,
    floor,
    info,
    keys,
    map_file,
    missions,
    open_map,
    place,
    plan,
    portal,
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
from mapweave.commands.examples import add_examples
from mapweave.commands.usage import UsageError
from mapweave.early_interrupt import came, remember
from mapweave.exit_status import FAILED, INTERRUPTED, MISSING_EXTRA, NO, USAGE
from mapweave.extras import MissingExtra, extra_of
from mapweave.hybridmap.errors import MapweaveError, Refused
from mapweave.json_log import escaped, json_line
from mapweave.storage.os_errors import reason_of

EPILOG = "Start with `mapweave demo`. Each command has its own --help, with examples."
NEGATIVE = re.compile(r"-[0-9.][0-9.,=e+-]*$")
"""Positions and poses begin with a minus as well: -3.1,2 and -3.1,2=40,50."""


class CommandParser(argparse.ArgumentParser):
    """A parser whose arguments name the command that was given, as `command`, and its parser, as `parser`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Make a parser; those of its commands are of this class, too."""
        super().__init__(*args, **kwargs)
        self.set_defaults(command=self.prog, parser=self)
        # Positions begin with a minus as well, and are no options: -3.1,2 and -3.1,2=40,50.
        self._negative_number_matcher = NEGATIVE
        self._given: Sequence[str] = ()

    def parse_known_args(  # type: ignore[override]
        self, args: Any = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse, and remember what was given, of which an error may be."""
        self._given = sys.argv[1:] if args is None else args
        return super().parse_known_args(args, namespace)

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        """Read a value; if it is none, say of which argument."""
        try:
            return super()._get_value(action, arg_string)
        except UsageError as error:
            option = action.option_strings[-1:]
            which = f"{option[0]} {arg_string}" if option else f"{action.dest} {arg_string!r}"
            raise UsageError(f"{which}: {error}") from None

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a command that is none with the nearest one, rather than with all forty."""
        if not isinstance(action, argparse._SubParsersAction) or value in action.choices:
            super()._check_value(action, value)
            return
        near = get_close_matches(value, action.choices, 1)
        meant = f"did you mean `{self.prog} {near[0]}`?" if near else f"`{self.prog} --help` lists them"
        raise UsageError(f"no command `{self.prog} {value}`; {meant}")

    def error(self, message: str) -> NoReturn:
        """End with status 2: in one line, as every error."""
        taken = next((word for word in self._given if word.startswith("-") and _is_file(word)), None)
        advice = f"write ./{taken}: {taken} is taken for options" if taken else f"see `{self.prog} --help`"
        self.exit(USAGE, f"{self.prog}: {message}; {advice}\n")


def _is_file(word: str) -> bool:
    """Whether a word on the command line is the name of a file or folder here."""
    try:
        return os.path.lexists(word)
    except ValueError:  # a null byte
        return False


class PrintVersion(argparse.Action):
    """Print the version and exit; it is looked up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it."""
        from importlib.metadata import version

        # As argparse writes its help: mapweave.start sees whether all of it was written.
        parser._print_message(f"mapweave {version('mapweave')}\n", sys.stdout)
        parser.exit()


@cache
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
        demo, server, router, sim, agent, drive, status, missions, place, plan, closures, floor, portal, keys,
        robots, doctor, find_port, find_cameras, calibrate, map_file, open_map, record, replay, info,
        relocalize, evaluate, settings, completion,
    ):  # fmt: skip
        command.add_to(commands)
    add_examples(top)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        See `mapweave.exit_status`; argparse itself exits with 2 on a wrong command line.
    """
    remember()
    # FAISS reads this when it is imported. On a busy machine its threads spin while they wait for each other:
    # a search by two of them took three times the processor time of a search by one, and longer.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # OpenCV and its FFmpeg read these likewise. What they print comes beside the one line of an error.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # Where the home cannot be written, as that of a service, Matplotlib says in two lines where its cache is.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    commands = parser()
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(commands)
    try:
        arguments, unknown = commands.parse_known_args(argv)
    except UsageError as error:
        _complain(str(error))
        return USAGE
    if unknown:
        # The help of the command that was given says more than that of `mapweave`.
        arguments.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    try:
        return int(arguments.run(arguments))
    except MissingExtra as error:
        print(f"{arguments.command} {error}", file=sys.stderr)
        return MISSING_EXTRA
    except ModuleNotFoundError as error:
        extra = extra_of(error.name)
        if extra is None or came():
            raise
        print(f"{arguments.command} {MissingExtra([extra])}", file=sys.stderr)
        return MISSING_EXTRA
    except UsageError as error:
        _complain(str(error))
        return USAGE
    except Refused as error:
        _complain(str(error))
        return NO
    except MapweaveError as error:
        _complain(str(error))
        return FAILED
    except KeyboardInterrupt:
        _complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        return FAILED
    except OSError as error:
        reason = reason_of(error)
        if isinstance(error, FileExistsError):
            reason = "is a file; give a folder, or a place where one can be made"
        elif isinstance(error, NotADirectoryError):
            reason = "cannot be made: what it should be in is a file"
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{where}{reason}")
        return FAILED


def _complain(words: str) -> None:
    """Say why the command ends, as all else that a process logs."""
    # A word may be of a file, whose name and content are another's.
    lines = "\n".join(map(escaped, words.splitlines()))
    print(json_line(words, logging.ERROR) or f"mapweave: {lines}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
