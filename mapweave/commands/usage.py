"""Command lines that argparse takes and that mean nothing."""

from collections.abc import Iterator
from contextlib import contextmanager

from mapweave.hybridmap.errors import InvalidValue, Refused, SettingsError


class UsageError(InvalidValue):
    """Arguments that do not go together, or a word that cannot stand there: exit status 2, as argparse's."""


@contextmanager
def arguments_read() -> Iterator[None]:
    """Within it words of the command line are read; a name among them may be looked up in a map.

    Raises:
        Refused: the map does not have the name.
        UsageError: instead of any other InvalidValue, or SettingsError.
    """
    try:
        yield
    except Refused:
        raise
    except (InvalidValue, SettingsError) as error:
        raise UsageError(str(error)) from error
