"""Questions about the fleet's map and their answers as bytes: see mapweave.hybridmap.query for what they
mean.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import MapId, NodeId, check_name
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    Certainty,
    KnownAnswer,
    RelocalizeAnswer,
    RouteAnswer,
    RouteLeg,
    View,
    Whereabouts,
)
from mapweave.wire.codec import EDGE_KINDS, KINDS_OF_EDGE, MAX_BODY_BYTES, decode_body, encode_body
from mapweave.wire.landmark_codec import MAX_LANDMARKS, MAX_LANDMARKS_BYTES, pack_features, unpack_features
from mapweave.wire.packing import MAX_NUMBER, Reader, pack
from mapweave.wire.pose_codec import MAX_POSITION, pack_camera, pack_pose, unpack_camera, unpack_pose

MAX_VIEW_BYTES = MAX_LANDMARKS_BYTES + 256
MAX_CANDIDATES = 64
MAX_LEGS = 512
"""A route through a building has tens of legs."""
MAX_ROUTE_BYTES = 8 * 2**20
"""16 kB a leg; a node takes about 3 kB."""
MAX_REASON = 1024
MAX_KNOWN = 512
"""Views in one answer: 8 kB, as much as two or three nodes."""
NO_KIND = 0
"""Stands for the first leg's missing edge kind."""


MAX_BLOCKED = 256


@dataclass(frozen=True, slots=True)
class RouteRequest:
    """How does one get from node to node?

    Attributes:
        start: node that the robot knows itself by.
        goal: node where it wants to be.
        blocked: pairs of nodes between which it could not drive.
        start_from_robot: where it is exactly.
    """

    start: NodeId
    goal: NodeId
    blocked: tuple[tuple[NodeId, NodeId], ...] = ()
    start_from_robot: Pose2 = field(default_factory=Pose2)


VIEW_TYPE = np.dtype("<f4")
VIEW_BYTES = 4 * VIEW_TYPE.itemsize


@dataclass(frozen=True, slots=True)
class KnownRequest:
    """What have others mapped around a position?

    Attributes:
        map: the asking robot's own.
        x: m, in that map.
        y: m, in that map.
        reach: how far around, m.
    """

    map: MapId
    x: float
    y: float
    reach: float


def encode_view(view: View) -> bytes:
    """Encode a view; raises InvalidValue if it would not decode."""
    return pack({"c": pack_camera(view.camera), "m": pack_features(view.pixels, view.codes, view.camera)})


def decode_view(data: bytes) -> View:
    """Decode a view; raises InvalidMessage."""
    reader = Reader(data, "view", MAX_VIEW_BYTES)
    camera = unpack_camera(reader.binary("c", MAX_VIEW_BYTES))
    pixels, codes = unpack_features(reader.binary("m", MAX_VIEW_BYTES), camera)
    return View(pixels, codes, camera)


def encode_relocalize_answer(answer: RelocalizeAnswer) -> bytes:
    """Encode where a view was taken; raises InvalidValue if it would not decode."""
    candidates = [_candidate(candidate) for candidate in answer.candidates]
    data = pack({"y": answer.certainty.value, "w": candidates, "r": answer.reason})
    return _checked(data, decode_relocalize_answer)


def decode_relocalize_answer(data: bytes) -> RelocalizeAnswer:
    """Decode where a view was taken; raises InvalidMessage."""
    reader = Reader(data, "relocalization", MAX_CANDIDATES * 512 + 4 * MAX_REASON)
    certainty = reader.text("y", 16)
    if certainty not in set(Certainty):
        raise reader.error(f"certainty {certainty!r} is unknown")
    candidates = tuple(_read_candidate(reader, one) for one in reader.array("w", MAX_CANDIDATES))
    return RelocalizeAnswer(Certainty(certainty), candidates, reader.text("r", MAX_REASON))


def encode_route_request(request: RouteRequest) -> bytes:
    """Encode a wish for a way; raises InvalidValue if it would not decode."""
    blocked = [[list(a), list(b)] for a, b in request.blocked]
    here = [float(number) for number in request.start_from_robot.vector]
    data = pack({"a": list(request.start), "b": list(request.goal), "n": blocked, "s": here})
    return _checked(data, decode_route_request)


def decode_route_request(data: bytes) -> RouteRequest:
    """Decode a wish for a way; raises InvalidMessage."""
    reader = Reader(data, "route request", MAX_BLOCKED * 128 + 1024)
    here = reader.array("s", 3) if reader.has("s") else [0.0, 0.0, 0.0]
    if len(here) != 3:
        raise reader.error("start_from_robot must be three numbers")
    x, y, heading = (
        reader.as_number(number, "start_from_robot", -MAX_POSITION, MAX_POSITION) for number in here
    )
    return RouteRequest(reader.node_id("a"), reader.node_id("b"), read_blocked(reader), Pose2(x, y, heading))


def read_blocked(reader: Reader) -> tuple[tuple[NodeId, NodeId], ...]:
    """Pairs of nodes between which a robot cannot drive, if any are told; raises InvalidMessage."""
    blocked = []
    for value in reader.array("n", MAX_BLOCKED) if reader.has("n") else []:
        pair = reader.as_array(value, "blocked pair", 2)
        if len(pair) != 2:
            raise reader.error("a blocked pair must be two nodes")
        blocked.append((reader.as_node_id(pair[0], "node"), reader.as_node_id(pair[1], "node")))
    return tuple(blocked)


def encode_route_answer(answer: RouteAnswer) -> bytes:
    """Encode a way; raises InvalidValue if it would not decode."""
    legs = [
        [
            encode_body(NodePut(leg.node)),
            pack_pose(leg.previous_from_node),
            NO_KIND if leg.kind is None else EDGE_KINDS[leg.kind],
        ]
        for leg in answer.legs
    ]
    return _checked(pack({"g": legs, "r": answer.reason}), decode_route_answer)


def decode_route_answer(data: bytes) -> RouteAnswer:
    """Decode a way; raises InvalidMessage."""
    reader = Reader(data, "route", MAX_ROUTE_BYTES)
    legs = tuple(_read_leg(reader, leg) for leg in reader.array("g", MAX_LEGS))
    return RouteAnswer(legs, reader.text("r", MAX_REASON))


def encode_known_request(request: KnownRequest) -> bytes:
    """Encode a wish to know what others have mapped; raises InvalidValue if it would not decode."""
    at = [float(request.x), float(request.y)]
    data = pack({"m": [check_name(request.map.agent), request.map.epoch], "p": at, "d": float(request.reach)})
    return _checked(data, decode_known_request)


def decode_known_request(data: bytes) -> KnownRequest:
    """Decode a wish to know what others have mapped; raises InvalidMessage."""
    reader = Reader(data, "known request", 256)
    at = reader.array("p", 2)
    if len(at) != 2:
        raise reader.error("the position must be two numbers")
    x, y = (reader.as_number(number, "position", -MAX_POSITION, MAX_POSITION) for number in at)
    return KnownRequest(reader.map_id("m"), x, y, reader.number("d", 0.0, MAX_POSITION))


def encode_known_answer(answer: KnownAnswer) -> bytes:
    """Encode what others have mapped; raises InvalidValue if it would not decode."""
    data = pack({"k": np.asarray(answer.views, VIEW_TYPE).tobytes(), "r": answer.reason})
    return _checked(data, decode_known_answer)


def decode_known_answer(data: bytes) -> KnownAnswer:
    """Decode what others have mapped; raises InvalidMessage."""
    most = MAX_KNOWN * VIEW_BYTES
    reader = Reader(data, "known", most + 4 * MAX_REASON + 64)
    packed = reader.binary("k", most)
    if len(packed) % VIEW_BYTES:
        raise reader.error(f"views are {VIEW_BYTES} bytes each, not {len(packed)} in all")
    views = np.frombuffer(packed, VIEW_TYPE).reshape(-1, 4).astype(np.float64)
    # A comparison with what is no number is false.
    if not (np.abs(views) <= [MAX_POSITION, MAX_POSITION, 4.0, 4.0]).all() or (views[:, 3] < 0.0).any():
        raise reader.error("a view's pose or aperture is out of range")
    return KnownAnswer(views, reader.text("r", MAX_REASON))


def _candidate(place: Whereabouts) -> list[object]:
    merged = b"" if place.merged_from_robot is None else pack_pose(place.merged_from_robot)
    parts = [
        list(place.node),
        pack_pose(place.node_from_robot),
        merged,
        place.component,
        place.inliers,
        float(place.probability),
    ]
    return parts if place.distance_known else [*parts, 0]


def _read_candidate(reader: Reader, value: Any) -> Whereabouts:
    parts = reader.as_array(value, "candidate", 32)
    # More parts than are known here are a newer program's.
    if len(parts) < 6:
        raise reader.error(f"a candidate has {len(parts)} parts instead of 6")
    merged = reader.as_binary(parts[2], "merged pose", 64)
    return Whereabouts(
        node=reader.as_node_id(parts[0], "node"),
        node_from_robot=unpack_pose(reader.as_binary(parts[1], "pose", 64)),
        merged_from_robot=unpack_pose(merged) if merged else None,
        component=reader.as_integer(parts[3], "component", -1, MAX_NUMBER),
        inliers=reader.as_integer(parts[4], "inliers", 0, MAX_LANDMARKS),
        probability=reader.as_number(parts[5], "probability", 0.0, 1.0),
        distance_known=len(parts) < 7 or reader.as_integer(parts[6], "distance known", 0, 1) == 1,
    )


def _read_leg(reader: Reader, value: Any) -> RouteLeg:
    parts = reader.as_array(value, "leg", 32)
    if len(parts) < 3:
        raise reader.error(f"a leg has {len(parts)} parts instead of 3")
    body = decode_body(reader.as_binary(parts[0], "node", MAX_BODY_BYTES))
    if not isinstance(body, NodePut):
        raise reader.error("a leg leads to what is no node")
    pose: PoseGaussian = unpack_pose(reader.as_binary(parts[1], "pose", 64))
    kind = reader.as_integer(parts[2], "edge kind", NO_KIND, len(EDGE_KINDS))
    return RouteLeg(body.node, pose, None if kind == NO_KIND else KINDS_OF_EDGE[kind])


def _checked(data: bytes, decode: Any) -> bytes:
    """What a receiver would refuse is not sent."""
    try:
        decode(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data
