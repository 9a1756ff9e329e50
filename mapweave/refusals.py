"""What a map says to what is asked of it without a server: the same errors as a server's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mapweave.hybridmap.errors import InvalidValue, Refused


@contextmanager
def refusals() -> Iterator[None]:
    """Within it the map is asked: a value that it does not have, or that contradicts it, is refused.

    Raises:
        Refused: instead of InvalidValue.
    """
    try:
        yield
    except InvalidValue as error:
        raise Refused(str(error)) from error
