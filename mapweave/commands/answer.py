"""What a command answers: lines for people, or one JSON object, the last line on stdout, for scripts."""

import argparse
import json
import sys


def add_json(parser: argparse.ArgumentParser) -> None:
    """Declare `--json`."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def print_said(arguments: argparse.Namespace, *said: str, **values: object) -> None:
    """Print what was done: lines, or with `--json` one object with these words, as `said`, and values."""
    if arguments.json:
        print(json.dumps({"said": "; ".join(said), **values}))
    else:
        print("\n".join(said))


def print_note(arguments: argparse.Namespace, words: str) -> None:
    """Print what a person wants to know before the answer, at once; with `--json` on stderr."""
    print(words, file=sys.stderr if arguments.json else sys.stdout, flush=True)
