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


def check_component(number: int, count: int) -> None:
    """Check that one of so many components has a number.

    Raises:
        Refused: none has.
    """
    if not 0 <= number < count:
        choices = {0: "no nodes", 1: "one, 0"}.get(count, f"0 to {count - 1}")
        raise Refused(f"the map has no component {number}; it has {choices}")
