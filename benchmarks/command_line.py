"""The command line that all benchmarks share."""

from __future__ import annotations

import argparse


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
    parser.add_argument("--seed", type=_seed, default=0, help=f"{seed} (default 0)")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    return parser


def _seed(word: str) -> int:
    seed = int(word)
    if seed < 0:
        raise argparse.ArgumentTypeError(f"{seed}: give 0 or more")
    return seed
