"""Command lines that argparse takes and that mean nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mapweave.hybridmap.errors import InvalidValue


class UsageError(InvalidValue):
    """Arguments that do not go together, or a word that cannot stand there: exit status 2, as argparse's."""


@contextmanager
def arguments_read() -> Iterator[None]:
    """Within it words of the command line are read, and nothing is asked yet.

    Raises:
        UsageError: instead of InvalidValue.
    """
    try:
        yield
    except InvalidValue as error:
        raise UsageError(str(error)) from error
