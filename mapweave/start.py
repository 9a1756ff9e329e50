"""Where the command `mapweave` begins: Ctrl-C while the command line is read is one line, too."""

from __future__ import annotations

import sys

INTERRUPTED = 130
"""As in mapweave.exit_status; nothing else is imported here."""


def main() -> int:
    """Run a command; returns its exit status."""
    try:
        from mapweave.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("mapweave: interrupted", file=sys.stderr)
        return INTERRUPTED
