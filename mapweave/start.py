"""Where the command `mapweave` begins and ends: what holds for every command, also while its line is read.

Ctrl-C is one line, and so is an output that cannot be written.
"""

import os
import sys

FAILED = 1
INTERRUPTED = 130
"""As in mapweave.exit_status; nothing of the project is imported here."""


def main() -> int:
    """Run a command; returns its exit status."""
    _open_output()
    try:
        from mapweave.early_interrupt import came, remember

        remember()
        from mapweave.cli import main as run

        try:
            status = run()
        except SystemExit as end:
            # Argparse's own, after --help and --version as well.
            status = end.code if isinstance(end.code, int) else 0
        except ImportError:
            # A library in C may make an error of its own of an interrupt: "initialization failed".
            if came():
                raise KeyboardInterrupt from None
            raise
        return _flushed(status)
    except KeyboardInterrupt:
        print("mapweave: interrupted", file=sys.stderr)
        return _flushed(INTERRUPTED)


def _open_output() -> None:
    """Let commands print any text, also where nothing reads it."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # It was closed when the process began.
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    if sys.stdout.errors in ("strict", "surrogateescape"):
        # A name may have characters that the locale lacks, and the name of a file need not be UTF-8.
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def _flushed(status: int) -> int:
    """Write what is still in the buffer of stdout.

    Returns:
        The exit status: that a full disk or a closed pipe takes no more is a failure.
    """
    try:
        sys.stdout.flush()
        return status
    except OSError as error:
        from mapweave.storage.os_errors import reason_of

        # Python tries again at its end, and then says so in its own words, with status 120.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError) and status != FAILED:
            print(f"mapweave: standard output cannot be written ({reason_of(error)})", file=sys.stderr)
        return FAILED
