"""MessagePack with a guard at the door: every message is a map with its schema version.

A message has at most the length and the number of values that its kind allows. Its text is printable, on one
line, and its numbers are finite. `msgspec.convert` checks each field. An invalid message raises
InvalidMessage with one line.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgpack
import msgspec

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue, MapweaveError
from mapweave.wire.conversion import convert

SCHEMA = 1
"""Version of all messages; raised when a program of the version before would misread one."""

MAX_VALUES = 4096
"""Values in one message, unless its kind needs more: maps, lists, keys and what is in them each count as one.

An empty list is one byte on the wire and 64 bytes in memory, so the length of a message does not bound what
it costs to unpack."""

SIZES = [1] * 256
"""Bytes of a value by its first byte, without the children of a container and the payload of a binary."""
for _first, _size in (
    (0xC4, 2), (0xC5, 3), (0xC6, 5), (0xC7, 3), (0xC8, 4), (0xC9, 6), (0xCA, 5), (0xCB, 9), (0xCC, 2),
    (0xCD, 3), (0xCE, 5), (0xCF, 9), (0xD0, 2), (0xD1, 3), (0xD2, 5), (0xD3, 9), (0xD4, 3), (0xD5, 4),
    (0xD6, 6), (0xD7, 10), (0xD8, 18), (0xD9, 2), (0xDA, 3), (0xDB, 5), (0xDC, 3), (0xDD, 5), (0xDE, 3),
    (0xDF, 5),
):  # fmt: skip
    SIZES[_first] = _size


def pack(fields: Mapping[str, object], *, single_floats: bool = False) -> bytes:
    """Make a message of fields; the schema version goes first.

    Raises:
        InvalidValue: a number is too large for MessagePack.
    """
    try:
        packed: bytes = msgpack.packb({"v": SCHEMA, **fields}, use_single_float=single_floats)
    except (OverflowError, ValueError, TypeError) as error:
        raise InvalidValue(f"cannot be packed: {error}") from None
    return packed


class Limit(NamedTuple):
    """Limits of a kind of message.

    Attributes:
        what: its name, for the reason of a refusal.
        size: longest message that is read, bytes.
        values: most values in it, see MAX_VALUES. They are counted before any is created.
    """

    what: str
    size: int
    values: int = MAX_VALUES


def unpack(data: bytes, kind: Any, limit: Limit, read: Callable[[Any, Any], Any] | None = None) -> Any:
    """Read a message.

    Args:
        data: as received.
        kind: its type, for `msgspec.convert`.
        limit: of messages of this kind.
        read: returns values of types that msgspec does not know.

    Raises:
        InvalidMessage: the message is invalid; one line gives the reason.
    """
    try:
        return convert(_fields(data, limit), kind, read)
    except (msgspec.ValidationError, MapweaveError) as error:
        raise InvalidMessage(f"{limit.what}: {str(error).splitlines()[0][:300]}") from None


def _fields(data: bytes, limit: Limit) -> dict[str, Any]:
    if len(data) > limit.size:
        raise InvalidMessage(f"{len(data)} bytes, at most {limit.size} are allowed")
    # A value takes at least one byte, so short messages need no count.
    if len(data) > limit.values and _exceeds(data, limit.values):
        raise InvalidMessage(f"more than {limit.values} values")
    try:
        # The lengths that a message may claim are bounded by its own, so nothing huge is allocated.
        fields = msgpack.unpackb(data, strict_map_key=True, max_ext_len=0)
    except Exception as error:
        # msgpack raises a dozen types, depending on the byte at which it stumbles.
        reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
        raise InvalidMessage(f"no MessagePack ({reason})") from error
    if not isinstance(fields, dict):
        raise InvalidMessage("no map of fields")
    if "v" not in fields:
        raise InvalidMessage("Object missing required field `v`")
    if type(fields["v"]) is not int or fields["v"] != SCHEMA:
        raise InvalidMessage(f"schema version {fields['v']!r:.20}, this program speaks {SCHEMA}")
    _check(fields)
    return fields


def _check(fields: dict[str, Any]) -> None:
    """Refuse text that is not printable and numbers that are not finite, at any depth."""
    values: list[Any] = [fields]
    for value in values:  # it grows meanwhile
        kind = type(value)
        if kind is str:
            if not value.isprintable():
                raise InvalidMessage("text must be one printable line")
        elif kind is float:
            if not math.isfinite(value):
                raise InvalidMessage(f"{value:g} is not finite")
        elif kind is dict:
            values += value
            values += value.values()
        elif kind is list:
            values += value


def _exceeds(data: bytes, most: int) -> bool:
    """Whether MessagePack holds more values than so many, by the heads of the values alone."""
    at, left, count = 0, 1, 1
    while left and at < len(data):
        first = data[at]
        end = at + SIZES[first]
        children = payload = 0
        if 0x80 <= first <= 0x8F:
            children = 2 * (first & 0x0F)
        elif 0x90 <= first <= 0x9F:
            children = first & 0x0F
        elif 0xA0 <= first <= 0xBF:
            payload = first & 0x1F
        elif first in (0xDC, 0xDD):
            children = int.from_bytes(data[at + 1 : end], "big")
        elif first in (0xDE, 0xDF):
            children = 2 * int.from_bytes(data[at + 1 : end], "big")
        elif 0xC4 <= first <= 0xC6 or 0xD9 <= first <= 0xDB:
            payload = int.from_bytes(data[at + 1 : end], "big")
        elif 0xC7 <= first <= 0xC9:
            payload = int.from_bytes(data[at + 1 : end - 1], "big")
        count += children
        if count > most:
            return True
        left += children - 1
        at = end + payload
    return False
