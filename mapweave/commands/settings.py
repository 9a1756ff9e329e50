"""`mapweave settings`: what can be set, and how it is set without a file."""

import argparse
from typing import Any


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "settings",
        help="print all settings with their defaults, as a settings file",
        description="Print a settings file with all defaults, units and ranges. Keep what you change, and "
        "give the file to a command as --settings FILE.",
    )
    parser.add_argument("--markdown", action="store_true", help="print the page docs/settings.md instead")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print it."""
    from mapweave.settings_reference import as_markdown, as_toml

    print(as_markdown() if arguments.markdown else as_toml(), end="")
    return 0
