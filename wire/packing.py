"""MessagePack with a guard at the door: every message is a map with its schema version, read field by field.

A reader asks for the fields that it knows and says what each must be; other fields are not looked at, so a
newer program may add some. Whatever is wrong with a message, an InvalidMessage with one line comes out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgpack

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import MapId, NodeId, check_name
from mapweave.wire.keys import MAX_EPOCH

SCHEMA = 1
"""Version of all messages; raised when a program of the version before would misread one."""

MAX_NUMBER = 2**53
"""Largest node number, sequence number and the like: exact in every language's numbers."""

MAX_STAMP_NS = 2**63 - 1

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


class Reader:
    """A message taken apart. Every method raises InvalidMessage if the field is missing or not as asked."""

    def __init__(self, data: bytes, what: str, limit: int, values: int = MAX_VALUES) -> None:
        """Take a message apart.

        Args:
            data: as it came.
            what: what it should be, for the reason.
            limit: longest message that is looked at, bytes.
            values: most values in it, see MAX_VALUES. They are counted before any is made.

        Raises:
            InvalidMessage: too long, too many values, no MessagePack map with text keys, or another schema.
        """
        self._what = what
        if len(data) > limit:
            raise self.error(f"{len(data)} bytes, at most {limit} are allowed")
        # A value takes at least one byte, so short messages need no count.
        if len(data) > values and _exceeds(data, values):
            raise self.error(f"more than {values} values")
        try:
            # The lengths that a message may claim are bounded by its own, so nothing huge is allocated.
            fields = msgpack.unpackb(data, strict_map_key=True, max_ext_len=0)
        except Exception as error:
            # msgpack raises a dozen types, depending on the byte at which it stumbles.
            reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
            raise self.error(f"no MessagePack ({reason})") from error
        if not isinstance(fields, dict):
            raise self.error("no map of fields")
        self._fields: dict[Any, Any] = fields
        version = self.integer("v", 0, MAX_NUMBER)
        if version != SCHEMA:
            raise self.error(f"schema version {version}, this program speaks {SCHEMA}")

    def error(self, reason: str) -> InvalidMessage:
        """What to raise."""
        return InvalidMessage(f"{self._what}: {reason}")

    def has(self, name: str) -> bool:
        """Whether the field is there."""
        return name in self._fields

    def any(self, name: str) -> Any:
        """Whatever it is; give it to the methods that begin with `as_`."""
        return self._get(name)

    def integer(self, name: str, low: int, high: int) -> int:
        """An integer in a closed range."""
        return self.as_integer(self._get(name), name, low, high)

    def number(self, name: str, low: float, high: float) -> float:
        """A finite number in a closed range."""
        return self.as_number(self._get(name), name, low, high)

    def text(self, name: str, longest: int) -> str:
        """Printable text, on one line."""
        return self.as_text(self._get(name), name, longest)

    def name(self, name: str) -> str:
        """What an agent, server or fleet may be called."""
        return self.as_name(self._get(name), name)

    def binary(self, name: str, longest: int) -> bytes:
        """Bytes."""
        return self.as_binary(self._get(name), name, longest)

    def array(self, name: str, most: int) -> list[Any]:
        """A list whose elements nobody has looked at yet; give them to the methods that begin with `as_`."""
        return self.as_array(self._get(name), name, most)

    def table(self, name: str, most: int) -> dict[str, Any]:
        """A map with text keys of at most 32 characters whose values nobody has looked at yet."""
        value = self._get(name)
        if not isinstance(value, dict) or len(value) > most:
            raise self.error(f"{name} must be a map of at most {most}")
        return {self.as_text(key, f"a key of {name}", 32): element for key, element in value.items()}

    def map_id(self, name: str) -> MapId:
        """[agent, epoch]."""
        return self.as_map_id(self._get(name), name)

    def node_id(self, name: str) -> NodeId:
        """[agent, epoch, number]."""
        return self.as_node_id(self._get(name), name)

    # The same for elements of lists and maps.

    def as_array(self, value: Any, name: str, most: int) -> list[Any]:
        """See `array`."""
        if not isinstance(value, list) or len(value) > most:
            raise self.error(f"{name} must be a list of at most {most}")
        return value

    def as_map_id(self, value: Any, name: str) -> MapId:
        """See `map_id`."""
        parts = self.as_array(value, name, 2)
        if len(parts) != 2:
            raise self.error(f"{name} must be [agent, epoch]")
        return MapId(self.as_name(parts[0], name), self.as_integer(parts[1], f"{name}'s epoch", 0, MAX_EPOCH))

    def as_node_id(self, value: Any, name: str) -> NodeId:
        """See `node_id`."""
        parts = self.as_array(value, name, 3)
        if len(parts) != 3:
            raise self.error(f"{name} must be [agent, epoch, number]")
        return NodeId(
            self.as_name(parts[0], name),
            self.as_integer(parts[1], f"{name}'s epoch", 0, MAX_EPOCH),
            self.as_integer(parts[2], f"{name}'s number", 0, MAX_NUMBER),
        )

    def _get(self, name: str) -> Any:
        if name not in self._fields:
            raise self.error(f"{name} is missing")
        return self._fields[name]

    def as_integer(self, value: Any, name: str, low: int, high: int) -> int:
        """See `integer`."""
        if type(value) is not int or not low <= value <= high:
            raise self.error(f"{name} must be an integer in {low}..{high}")
        return value

    def as_number(self, value: Any, name: str, low: float, high: float) -> float:
        """See `number`."""
        if type(value) not in (int, float) or not math.isfinite(value) or not low <= value <= high:
            raise self.error(f"{name} must be a number in {low:g}..{high:g}")
        return float(value)

    def as_text(self, value: Any, name: str, longest: int) -> str:
        """See `text`."""
        if type(value) is not str or len(value) > longest or not value.isprintable():
            raise self.error(f"{name} must be printable text of at most {longest} characters")
        return value

    def as_name(self, value: Any, name: str) -> str:
        """See `name`."""
        try:
            return check_name(self.as_text(value, name, 32))
        except InvalidValue as error:
            raise self.error(str(error)) from None

    def as_binary(self, value: Any, name: str, longest: int) -> bytes:
        """See `binary`."""
        if type(value) is not bytes or len(value) > longest:
            raise self.error(f"{name} must be at most {longest} bytes")
        return value


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
