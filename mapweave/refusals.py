"""What a map says to what is asked of it without a server: the same errors as a server's."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.named_nodes import NodeWord, is_position

Name = TypeVar("Name", bound=NodeWord)


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


def listed(name: str, given: Iterable[Name]) -> tuple[Name, ...]:
    """What a list has; one text would be taken for as many names as it has letters.

    Raises:
        InvalidValue: it is one node, one name or one position.
    """
    if isinstance(given, str | NodeId) or is_position(given):
        one = given if is_position(given) else str(given)
        raise InvalidValue(f"`{name}` is a list, such as [{one!r}], and not one place")
    return tuple(given)


def check_component(number: int, count: int) -> None:
    """Check that one of so many components has a number.

    Raises:
        Refused: none has.
    """
    if not 0 <= number < count:
        choices = {0: "no nodes", 1: "one, 0"}.get(count, f"0 to {count - 1}")
        raise Refused(f"the map has no component {number}; it has {choices}")
