"""docs/figures.md, docs/scale.md and README.md's table of stored results, and the results themselves.

    python -m benchmarks.figures [--run NAME ... [--data DIR]]

Without --run the pages are written of the results in docs/figures/. With it the named measurements run first,
one after the other, each in a process of its own.
"""

import argparse
from pathlib import Path

from benchmarks.command_line import failing_in_one_line
from benchmarks.figures.measurements import MEASUREMENTS
from benchmarks.figures.page import page, with_table
from benchmarks.figures.results import FOLDER, load, run, store
from benchmarks.figures.scale import scale_page

PAGE = FOLDER.with_suffix(".md")
SCALE = FOLDER.with_name("scale.md")
README = FOLDER.parents[1] / "README.md"


def written_pages() -> dict[Path, str]:
    """The pages as the stored results have them.

    Raises:
        MapweaveError: a result is missing or cannot be read.
    """
    results = {name: load(name) for name in MEASUREMENTS}
    readme = with_table(README.read_text(encoding="utf-8"), results)
    return {PAGE: page(results), SCALE: scale_page(results), README: readme}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.figures", description=__doc__.splitlines()[0])
    parser.add_argument("--run", nargs="+", default=[], choices=list(MEASUREMENTS), metavar="NAME",
                        help=f"measure first: {', '.join(MEASUREMENTS)}")  # fmt: skip
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of recordings, DATA in commands")
    arguments = parser.parse_args()
    with failing_in_one_line("figures"):
        for name in arguments.run:
            print(store(name, run(MEASUREMENTS[name], arguments.data)))
        for path, text in written_pages().items():
            path.write_text(text, encoding="utf-8")
            print(path)
