"""Why a route leads the way it does, or why there is none, as bytes."""

from __future__ import annotations

import math
from typing import Any

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.explanation import Hop, RouteExplanation
from mapweave.wire.explanation_messages import pack_maps, read_maps
from mapweave.wire.packing import Reader, pack
from mapweave.wire.pose_codec import MAX_POSITION

MAX_HOPS = 4096
MAX_WORDS = 1024
MAX_REASON = 4096
MAX_COST = 1e9
MAX_BYTES = 16_000_000


def encode_route_explanation(told: RouteExplanation) -> bytes:
    """Encode it; raises InvalidValue if it would not decode: a way of more than 4096 steps."""
    fields: dict[str, object] = {
        "a": list(told.start),
        "b": list(told.goal),
        "f": int(told.found),
        "r": told.reason,
        "h": [_pack_hop(hop) for hop in told.hops],
        "g": [_pack_hop(hop) for hop in told.gaps],
    }
    if told.apart is not None:
        fields["m"] = pack_maps(told.apart)
    data = pack(fields)
    try:
        decode_route_explanation(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def decode_route_explanation(data: bytes) -> RouteExplanation:
    """Decode it; raises InvalidMessage."""
    reader = Reader(data, "explanation of a route", MAX_BYTES, MAX_HOPS * 32)
    return RouteExplanation(
        reader.node_id("a"),
        reader.node_id("b"),
        reader.integer("f", 0, 1) == 1,
        reader.text("r", MAX_REASON),
        tuple(_read_hop(reader, value) for value in reader.array("h", MAX_HOPS)),
        tuple(_read_hop(reader, value) for value in reader.array("g", MAX_HOPS)),
        read_maps(reader, reader.any("m")) if reader.has("m") else None,
    )


def _pack_hop(hop: Hop) -> list[object]:
    numbers = [float(value) for value in (hop.distance, hop.turn, hop.cost)]
    return [list(hop.a), list(hop.b), hop.kind, *numbers, hop.words]


def _read_hop(reader: Reader, value: Any) -> Hop:
    parts = reader.as_array(value, "hop", 32)
    # More parts than are known here are a newer program's.
    if len(parts) < 7:
        raise reader.error(f"a hop has {len(parts)} parts instead of 7")
    return Hop(
        reader.as_node_id(parts[0], "node"),
        reader.as_node_id(parts[1], "node"),
        reader.as_text(parts[2], "kind", 16),
        reader.as_number(parts[3], "distance", 0.0, 4 * MAX_POSITION),
        reader.as_number(parts[4], "turn", -math.tau, math.tau),
        reader.as_number(parts[5], "cost", 0.0, MAX_COST),
        reader.as_text(parts[6], "words", MAX_WORDS),
    )
