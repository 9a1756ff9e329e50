"""docs/figures.md of stored results, and the results themselves.

    python -m benchmarks.figures [--run NAME ... [--data DIR]]

Without --run the page is written of the results in docs/figures/. With it the named measurements run first,
one after the other, each in a process of its own.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.figures.measurements import MEASUREMENTS
from benchmarks.figures.page import page
from benchmarks.figures.results import FOLDER, load, run, store
from mapweave.hybridmap.errors import MapweaveError

PAGE = FOLDER.with_suffix(".md")


def written_page() -> str:
    """The page as the stored results have it.

    Raises:
        MapweaveError: a result is missing or cannot be read.
    """
    return page({name: load(name) for name in MEASUREMENTS})


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.figures", description=__doc__.splitlines()[0])
    parser.add_argument("--run", nargs="+", default=[], choices=list(MEASUREMENTS), metavar="NAME",
                        help=f"measure first: {', '.join(MEASUREMENTS)}")  # fmt: skip
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of recordings, DATA in commands")
    arguments = parser.parse_args()
    try:
        for name in arguments.run:
            print(store(name, run(MEASUREMENTS[name], arguments.data)))
        PAGE.write_text(written_page(), encoding="utf-8")
        print(PAGE)
    except (MapweaveError, OSError) as problem:
        print(f"figures: {problem}", file=sys.stderr)
        raise SystemExit(1) from None
