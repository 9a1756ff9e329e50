"""Questions why nodes or maps are linked or are not, and what people rule of it, as bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.explanation import (
    MapsExplanation,
    Misfit,
    NearMiss,
    PairExplanation,
    Standing,
    Witness,
)
from mapweave.hybridmap.manual_constraint import Ends, ManualConstraint
from mapweave.hybridmap.node import Node, NodeId
from mapweave.wire.codec import MAX_BODY_BYTES, MAX_EVIDENCE, decode_body, encode_body
from mapweave.wire.landmark_codec import MAX_LANDMARKS
from mapweave.wire.manual_constraint_codec import pack_manual_constraint, read_ends, read_manual_constraint
from mapweave.wire.messages import MAX_BLOCKED, read_blocked
from mapweave.wire.packing import MAX_NUMBER, Reader, pack
from mapweave.wire.pose_codec import MAX_POSITION, pack_pose, unpack_pose

MAX_MAPS_TOLD = 256
"""Pairs of maps in one answer."""
MAX_NEAREST = 64
MAX_WITNESSES = 4096
MAX_CLAIMS = 256
MAX_RULINGS = 4096
MAX_REASON = 4096
MAX_PAIR_BYTES = 2 * MAX_BODY_BYTES + 4_000_000
MAX_MAPS_BYTES = 4_000_000
MAX_PAIR_VALUES = 16 * (MAX_WITNESSES + MAX_RULINGS)
MAX_MAPS_VALUES = 16 * MAX_MAPS_TOLD * MAX_NEAREST
INFINITE = 1e300
"""Stands for a number beyond all bounds."""


@dataclass(frozen=True, slots=True)
class ExplainRequest:
    """Why are these linked, or are not? Or why does a route lead this way, and why is there none?

    Attributes:
        ends: two nodes or two maps, for a route start and goal; None for each two maps of the fleet.
        route: whether it is about the route between two nodes.
        blocked: for a route, pairs of nodes between which the robot cannot drive.
    """

    ends: Ends | None = None
    route: bool = False
    blocked: tuple[tuple[NodeId, NodeId], ...] = ()

    def __post_init__(self) -> None:
        """Refuse routes from what is no node (InvalidValue)."""
        if self.route and (self.ends is None or not all(isinstance(end, NodeId) for end in self.ends)):
            raise InvalidValue("a route leads from node to node: r0.1.17 r1.1.5")


def encode_explain_request(request: ExplainRequest) -> bytes:
    """Encode a question; raises InvalidValue if it would not decode."""
    fields: dict[str, object] = {}
    if request.ends is not None:
        fields["e"] = [list(end) for end in request.ends]
    if request.route:
        fields |= {"w": 1, "n": [[list(a), list(b)] for a, b in request.blocked]}
    return _checked(pack(fields), decode_explain_request)


def decode_explain_request(data: bytes) -> ExplainRequest:
    """Decode a question; raises InvalidMessage."""
    reader = Reader(data, "explain request", MAX_BLOCKED * 128 + 1024)
    if not reader.has("e"):
        return ExplainRequest()
    ends = reader.array("e", 2)
    if len(ends) != 2:
        raise reader.error("two nodes or two maps are needed")
    both = read_ends(reader, ends[0], ends[1])
    if not reader.has("w"):
        return ExplainRequest(both)
    reader.integer("w", 1, 1)
    try:
        return ExplainRequest(both, True, read_blocked(reader))
    except InvalidValue as error:
        raise reader.error(str(error)) from None


def encode_ruling(ruling: ManualConstraint) -> bytes:
    """Encode what somebody rules; raises InvalidValue if it would not decode."""
    return _checked(pack({"r": pack_manual_constraint(ruling)}), decode_ruling)


def decode_ruling(data: bytes) -> ManualConstraint:
    """Decode what somebody rules; raises InvalidMessage."""
    reader = Reader(data, "ruling", 4096)
    return read_manual_constraint(reader, reader.any("r"))


def encode_pair(told: PairExplanation) -> bytes:
    """Encode the explanation of two nodes; raises InvalidValue if it would not decode."""
    fields: dict[str, object] = {
        "a": encode_body(NodePut(told.a)),
        "b": encode_body(NodePut(told.b)),
        "y": told.standing.value,
        "r": told.reason,
        "m": _pack_pairs(told.matches),
        "h": _pack_pairs(told.shared),
        "u": [_bounded(value) for value in told.residuals_px],
        "w": [[list(w.a), list(w.b), _bounded(w.distance2), w.agrees, w.kept] for w in told.witnesses],
        "c": list(told.claims),
        "g": [pack_manual_constraint(ruling) for ruling in told.rulings],
    }
    if told.a_from_b is not None:
        fields["p"] = pack_pose(told.a_from_b)
        fields["x"] = {name: float(value) for name, value in told.evidence.items()}
    if told.probability is not None:
        fields["q"] = float(told.probability)
    if told.misfit is not None:
        misfit = told.misfit
        off = [float(value) for value in misfit.off]
        fields["f"] = [pack_pose(misfit.merged_a_from_b), off, _bounded(misfit.strain2), misfit.alone]
    return _checked(pack(fields), decode_pair)


def decode_pair(data: bytes) -> PairExplanation:
    """Decode the explanation of two nodes; raises InvalidMessage."""
    reader = Reader(data, "explanation", MAX_PAIR_BYTES, MAX_PAIR_VALUES)
    standing = reader.text("y", 16)
    if standing not in set(Standing):
        raise reader.error(f"standing {standing!r} is unknown")
    a, b = _node(reader, "a"), _node(reader, "b")
    matches, shared = _read_pairs(reader, "m", a, b), _read_pairs(reader, "h", a, b)
    residuals = [
        float("nan") if value is None else reader.as_number(value, "residual", 0.0, INFINITE)
        for value in reader.array("u", MAX_LANDMARKS)
    ]
    if len(residuals) != len(shared):
        raise reader.error(f"{len(residuals)} residuals of {len(shared)} landmarks")
    evidence = reader.table("x", MAX_EVIDENCE) if reader.has("x") else {}
    return PairExplanation(
        a,
        b,
        Standing(standing),
        reader.text("r", MAX_REASON),
        matches,
        shared,
        np.array(residuals),
        unpack_pose(reader.binary("p", 64)) if reader.has("p") else None,
        {name: reader.as_number(value, name, -INFINITE, INFINITE) for name, value in evidence.items()},
        reader.number("q", 0.0, 1.0) if reader.has("q") else None,
        _misfit(reader) if reader.has("f") else None,
        tuple(_witness(reader, value) for value in reader.array("w", MAX_WITNESSES)),
        tuple(reader.as_text(value, "claim", MAX_REASON) for value in reader.array("c", MAX_CLAIMS)),
        tuple(read_manual_constraint(reader, value) for value in reader.array("g", MAX_RULINGS)),
    )


def encode_maps(told: tuple[MapsExplanation, ...]) -> bytes:
    """Encode explanations of maps; raises InvalidValue if they would not decode."""
    return _checked(pack({"m": [pack_maps(one) for one in told]}), decode_maps)


def decode_maps(data: bytes) -> tuple[MapsExplanation, ...]:
    """Decode explanations of maps; raises InvalidMessage."""
    reader = Reader(data, "explanation", MAX_MAPS_BYTES, MAX_MAPS_VALUES)
    return tuple(read_maps(reader, value) for value in reader.array("m", MAX_MAPS_TOLD))


def pack_maps(told: MapsExplanation) -> list[object]:
    """The explanation of two maps as a list."""
    return [
        list(told.first),
        list(told.second),
        told.joined,
        told.reason,
        [told.links, told.landmarks, told.refused, told.unverified],
        [[list(n.a), list(n.b), n.matches, n.inliers, n.lacks] for n in told.nearest],
        [pack_manual_constraint(ruling) for ruling in told.rulings],
    ]


def read_maps(reader: Reader, value: Any) -> MapsExplanation:
    """A list as the explanation of two maps; raises InvalidMessage."""
    parts = reader.as_array(value, "explanation of two maps", 32)
    if len(parts) < 7:
        raise reader.error(f"an explanation of two maps has {len(parts)} parts instead of 7")
    counts = reader.as_array(parts[4], "counts", 4)
    if len(counts) != 4:
        raise reader.error("four counts are needed")
    links, landmarks, refused, unverified = (
        reader.as_integer(count, "count", 0, MAX_NUMBER) for count in counts
    )
    return MapsExplanation(
        reader.as_map_id(parts[0], "map"),
        reader.as_map_id(parts[1], "map"),
        _flag(reader, parts[2]),
        reader.as_text(parts[3], "reason", MAX_REASON),
        links=links,
        landmarks=landmarks,
        refused=refused,
        unverified=unverified,
        nearest=tuple(_near(reader, near) for near in reader.as_array(parts[5], "nearest", MAX_NEAREST)),
        rulings=tuple(
            read_manual_constraint(reader, one) for one in reader.as_array(parts[6], "rulings", MAX_RULINGS)
        ),
    )


def _near(reader: Reader, value: Any) -> NearMiss:
    parts = reader.as_array(value, "near miss", 32)
    if len(parts) < 5:
        raise reader.error(f"a near miss has {len(parts)} parts instead of 5")
    return NearMiss(
        reader.as_node_id(parts[0], "node"),
        reader.as_node_id(parts[1], "node"),
        reader.as_integer(parts[2], "matches", 0, MAX_NUMBER),
        reader.as_integer(parts[3], "inliers", 0, MAX_NUMBER),
        reader.as_text(parts[4], "reason", MAX_REASON),
    )


def _misfit(reader: Reader) -> Misfit:
    parts = reader.array("f", 32)
    if len(parts) < 4:
        raise reader.error(f"a misfit has {len(parts)} parts instead of 4")
    off = [
        reader.as_number(value, "misfit", -2 * MAX_POSITION, 2 * MAX_POSITION)
        for value in reader.as_array(parts[1], "misfit", 3)
    ]
    if len(off) != 3:
        raise reader.error("a misfit must be three numbers")
    pose = unpack_pose(reader.as_binary(parts[0], "pose", 64))
    strain2 = reader.as_number(parts[2], "strain", 0.0, INFINITE)
    return Misfit(pose, np.array(off), strain2, _flag(reader, parts[3]))


def _witness(reader: Reader, value: Any) -> Witness:
    parts = reader.as_array(value, "witness", 32)
    if len(parts) < 5:
        raise reader.error(f"a witness has {len(parts)} parts instead of 5")
    a, b = (reader.as_node_id(part, "node") for part in parts[:2])
    distance2 = reader.as_number(parts[2], "distance", 0.0, INFINITE)
    return Witness(a, b, distance2, _flag(reader, parts[3]), _flag(reader, parts[4]))


def _flag(reader: Reader, value: Any) -> bool:
    if type(value) is not bool:
        raise reader.error("true or false is needed")
    return value


def _node(reader: Reader, name: str) -> Node:
    body = decode_body(reader.binary(name, MAX_BODY_BYTES))
    if not isinstance(body, NodePut):
        raise reader.error("what is explained is no node")
    return body.node


def _bounded(value: float) -> float | None:
    return None if np.isnan(value) else min(float(value), INFINITE)


def _pack_pairs(pairs: NDArray[np.int64]) -> bytes:
    return np.asarray(pairs, dtype="<u2").reshape(-1, 2).tobytes()


def _read_pairs(reader: Reader, name: str, a: Node, b: Node) -> NDArray[np.int64]:
    packed = reader.binary(name, 4 * MAX_LANDMARKS)
    if len(packed) % 4:
        raise reader.error("pairs of landmarks are 4 bytes each")
    pairs = np.frombuffer(packed, "<u2").reshape(-1, 2).astype(np.int64)
    if (pairs >= [len(a.landmarks), len(b.landmarks)]).any():
        raise reader.error("a landmark is named that the node does not have")
    return pairs


def _checked(data: bytes, decode: Any) -> bytes:
    """What a receiver would refuse is not sent."""
    try:
        decode(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data
