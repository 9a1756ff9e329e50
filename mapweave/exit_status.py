"""Exit statuses: the same of every command. docs/cheat-sheet.md lists them."""

DONE = 0
FAILED = 1
USAGE = 2
MISSING_EXTRA = 3
NO = 4
INTERRUPTED = 130

MEANINGS = {
    DONE: "it did what was asked; the answer is yes",
    FAILED: "it could not; one line on stderr says why and what to do: no server, a file that cannot be read",
    USAGE: "the command line is wrong; nothing was done",
    MISSING_EXTRA: "libraries are not installed; the line names the extra",
    NO: "it did its work, and the answer is no: not found, refused, given up, no way, expectations not met, "
    "a calibration that is not good enough, something wrong with a robot",
    INTERRUPTED: "it was interrupted by Ctrl-C",
}
"""2 is argparse's own."""
