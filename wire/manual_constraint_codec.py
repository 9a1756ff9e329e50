"""Rulings as lists of plain values: [end, end, apart, who, stamp, because], an end as in an id."""

from __future__ import annotations

from typing import Any

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.manual_constraint import MOST_WORDS, Ends, ManualConstraint
from mapweave.wire.packing import MAX_STAMP_NS, Reader


def pack_manual_constraint(ruling: ManualConstraint) -> list[object]:
    """A ruling as a list."""
    first, second = (list(end) for end in ruling.ends)
    return [first, second, ruling.apart, ruling.who, ruling.stamp_ns, ruling.because]


def read_manual_constraint(reader: Reader, value: Any) -> ManualConstraint:
    """A list as a ruling; raises InvalidMessage. More parts behind these are a newer program's."""
    parts = reader.as_array(value, "ruling", 32)
    if len(parts) < 6 or type(parts[2]) is not bool:
        raise reader.error("a ruling must be [end, end, apart, who, stamp, because]")
    try:
        return ManualConstraint(
            read_ends(reader, parts[0], parts[1]),
            parts[2],
            reader.as_text(parts[3], "who", MOST_WORDS),
            reader.as_integer(parts[4], "stamp", 0, MAX_STAMP_NS),
            reader.as_text(parts[5], "because", MOST_WORDS),
        )
    except InvalidValue as error:
        raise reader.error(str(error)) from None


def read_ends(reader: Reader, first: Any, second: Any) -> Ends:
    """Two nodes or two maps; raises InvalidMessage."""
    if isinstance(first, list) and isinstance(second, list) and len(first) == len(second) == 2:
        return reader.as_map_id(first, "end"), reader.as_map_id(second, "end")
    return reader.as_node_id(first, "end"), reader.as_node_id(second, "end")
