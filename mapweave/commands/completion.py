"""`mapweave completion SHELL`: what makes a shell complete commands and options."""

import argparse
from typing import Any

SHELLS = ("bash", "zsh", "fish")


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "completion",
        help="print what makes a shell complete commands and options",
        description="Print the code that makes a shell complete commands, options, choices and files. "
        "Append it to ~/.bashrc, or to ~/.zshrc after compinit; fish reads it from "
        "~/.config/fish/completions/mapweave.fish.",
    )
    parser.add_argument("shell", choices=SHELLS, help="which shell")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print it."""
    from argcomplete import shellcode  # type: ignore[attr-defined]

    print(shellcode(["mapweave"], shell=arguments.shell))
    return 0
