"""What all benchmarks share: their command line, how they fail, and a table of figures."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.table import Table

from mapweave.hybridmap.errors import MapweaveError


def command_line(
    name: str, about: str | None, seed: str = "of all that is drawn", whole: bool = False
) -> argparse.ArgumentParser:
    """A parser with `--seed`, which is 0 or more, and `--json`.

    Args:
        name: of the benchmark's folder.
        about: what it measures: the docstring of its module.
        seed: what the seed decides.
        whole: whether help shows all of `about`; else its first line.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=about if whole else (about or "").splitlines()[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help=f"{seed} (default 0)")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    return parser


def at_least(least: int) -> Callable[[str], int]:
    """The type of an argument that is a whole number, and at least so much."""

    def number(word: str) -> int:
        value = int(word)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value}: give at least {least}")
        return value

    return number


@contextmanager
def failing_in_one_line(name: str) -> Iterator[None]:
    """End with 1 and one line on stderr where a file, a folder or an argument is wrong.

    Args:
        name: of the benchmark's folder.
    """
    try:
        yield
    except (MapweaveError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def figure_table(
    columns: Mapping[str, Mapping[str, Any]], title: str = "", shown: Callable[[Any], str] = str
) -> Table:
    """A row for each figure, and a column for each of what was measured.

    Args:
        columns: figures by name, of each; what one lacks stays empty.
        title: of the table.
        shown: a figure in words.
    """
    table = Table("figure", *columns, title=title)
    for name in dict.fromkeys(name for column in columns.values() for name in column):
        table.add_row(name, *(shown(one[name]) if name in one else "" for one in columns.values()))
    return table
