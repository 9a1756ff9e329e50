"""What has happened to a merged map, as lists of plain values: [stamp, kind, words]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.node import MapId
from mapweave.wire.packing import MAX_STAMP_NS, Reader, pack

MAX_WORDS = 4096
MAX_HAPPENINGS = 100_000
MAX_MAPS = 100_000
MAX_BYTES = 2**26
MAX_VALUES = 4 * (MAX_HAPPENINGS + MAX_MAPS)


@dataclass(frozen=True)
class KeptHistory:
    """What a server keeps on its disk of what has happened.

    Attributes:
        happenings: in order.
        parts: maps that were one when it was written, each in one set.
        apart: pairs of maps that are reported as kept apart.
        set_apart: maps that are reported as set apart.
    """

    happenings: tuple[MapEvent, ...] = ()
    parts: tuple[frozenset[MapId], ...] = ()
    apart: frozenset[tuple[MapId, MapId]] = frozenset()
    set_apart: frozenset[MapId] = frozenset()


def encode_history(happenings: Sequence[MapEvent]) -> bytes:
    """What has happened, in order; raises InvalidValue if it would not decode."""
    data = pack({"h": [pack_happening(one) for one in happenings]})
    return _checked(data)


def decode_history(data: bytes) -> tuple[MapEvent, ...]:
    """The same back; raises InvalidMessage."""
    return _happenings(Reader(data, "history", MAX_BYTES, MAX_VALUES))


def encode_kept_history(kept: KeptHistory) -> bytes:
    """For a server's disk; raises InvalidValue if it would not decode."""
    data = pack(
        {
            "h": [pack_happening(one) for one in kept.happenings],
            "p": [[list(one) for one in sorted(part)] for part in kept.parts],
            "a": [[list(one), list(two)] for one, two in sorted(kept.apart)],
            "s": [list(one) for one in sorted(kept.set_apart)],
        }
    )
    return _checked(data)


def decode_kept_history(data: bytes) -> KeptHistory:
    """The same back; raises InvalidMessage."""
    reader = Reader(data, "history", MAX_BYTES, MAX_VALUES)
    parts = (_maps(reader, value) for value in reader.array("p", MAX_MAPS))
    apart = (_maps(reader, value) for value in reader.array("a", MAX_MAPS))
    return KeptHistory(
        _happenings(reader),
        tuple(frozenset(part) for part in parts),
        frozenset((pair[0], pair[1]) for pair in apart if len(pair) == 2),
        frozenset(_maps(reader, reader.any("s"))) if reader.has("s") else frozenset(),
    )


def _happenings(reader: Reader) -> tuple[MapEvent, ...]:
    return read_happenings(reader, "h")


def pack_happening(one: MapEvent) -> list[object]:
    """A happening as a list."""
    return [one.stamp_ns, one.kind.value, one.words]


def read_happenings(reader: Reader, name: str) -> tuple[MapEvent, ...]:
    """A list of lists as happenings; raises InvalidMessage. Kinds of a newer program are left out."""
    found = (_read(reader, value) for value in reader.array(name, MAX_HAPPENINGS))
    return tuple(one for one in found if one is not None)


def _read(reader: Reader, value: Any) -> MapEvent | None:
    parts = reader.as_array(value, "happening", 32)
    # More parts than are known here are a newer program's.
    if len(parts) < 3:
        raise reader.error(f"a happening has {len(parts)} parts instead of 3")
    kind = reader.as_text(parts[1], "kind", 16)
    stamp_ns = reader.as_integer(parts[0], "stamp", 0, MAX_STAMP_NS)
    words = reader.as_text(parts[2], "words", MAX_WORDS)
    return MapEvent(stamp_ns, MapEventKind(kind), words) if kind in set(MapEventKind) else None


def _maps(reader: Reader, value: Any) -> list[MapId]:
    return [reader.as_map_id(one, "map") for one in reader.as_array(value, "maps", MAX_MAPS)]


def _checked(data: bytes) -> bytes:
    try:
        decode_history(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data
