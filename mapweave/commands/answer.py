"""What a command answers: lines for people, or one JSON object, the last line on stdout, for scripts."""

import argparse
import json
import sys
from collections.abc import Iterable


def add_json(parser: argparse.ArgumentParser) -> None:
    """Declare `--json`."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def print_answer(arguments: argparse.Namespace, values: object, lines: Iterable[str]) -> None:
    """Print lines, which are made only for people, or with `--json` one object with values."""
    print(json.dumps(values) if arguments.json else "\n".join(lines))


def print_said(arguments: argparse.Namespace, *said: str, **values: object) -> None:
    """Print what was done: lines, or with `--json` one object with these words, as `said`, and values."""
    print_answer(arguments, {"said": "; ".join(said), **values}, said)


def print_note(arguments: argparse.Namespace, words: str) -> None:
    """Print what a person wants to know before the answer, at once; with `--json` on stderr."""
    print(words, file=sys.stderr if arguments.json else sys.stdout, flush=True)
