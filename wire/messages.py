"""Questions about the fleet's map, their answers, and manual constraints, as bytes.

See mapweave.hybridmap.query and mapweave.hybridmap.explanation for what they mean. Their fields travel under
their own names.
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from mapweave.hybridmap.agent_status import MAX_ROBOTS, MOST_AHEAD, AgentStatus, FleetStatus
from mapweave.hybridmap.annotation import Annotation, AnnotationRequest, Annotations
from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.drive_request import DriveAnswer, DriveRequest
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.explanation import Explanation, FleetExplanation, PairExplanation, RouteExplanation
from mapweave.hybridmap.floor_plan import PIECE, PlacedPlans, PlanPiece, PlanReceived
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import Stamp
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest, ManualConstraint
from mapweave.hybridmap.map_event import History, MapEvent
from mapweave.hybridmap.mission_order import MissionOrder, MissionReport, MissionRequest, Missions
from mapweave.hybridmap.nearby import NearbyAnswer, NearbyRequest
from mapweave.hybridmap.portal import PortalDone
from mapweave.hybridmap.pruned_node import PrunedNode
from mapweave.hybridmap.query import (
    MAX_CANDIDATES,
    MAX_KNOWN,
    ExplainRequest,
    KnownAnswer,
    KnownRequest,
    RelocalizeAnswer,
    ReserveAnswer,
    ReserveRequest,
    ResolveAnswer,
    ResolveRequest,
    RouteAnswer,
    RouteRequest,
    View,
)
from mapweave.hybridmap.view_image import MAX_BYTES, ViewImage, ViewRequest
from mapweave.wire import typed
from mapweave.wire.codec import MAX_BODY_BYTES
from mapweave.wire.landmark_codec import MAX_LANDMARKS_BYTES, pack_features, unpack_features
from mapweave.wire.packing import Limit, pack, unpack
from mapweave.wire.pose_codec import pack_camera, unpack_camera

Value = TypeVar("Value")


@dataclass(frozen=True)
class KeptHistory:
    """What a server keeps on its disk of what has happened.

    Attributes:
        events: in order.
        parts: maps that were one when it was written, each in one set.
        apart: pairs of maps that are reported as kept apart.
        set_apart: maps that are reported as set apart.
        contradicted: links by hand that are reported as contradicted.
        frames: pins that are reported as not holding their component's frame, with the node of the older pin
            that does; a pin whose node is not in the merged map with its own.
        implausible: maps that are reported as implausible.
        disbelieved: maps of which something said is not believed, and why: no store says it again.
    """

    events: tuple[MapEvent, ...] = ()
    parts: tuple[frozenset[MapId], ...] = ()
    apart: frozenset[tuple[MapId, MapId]] = frozenset()
    set_apart: frozenset[MapId] = frozenset()
    contradicted: frozenset[tuple[NodeId, NodeId]] = frozenset()
    frames: frozenset[tuple[NodeId, NodeId]] = frozenset()
    implausible: frozenset[MapId] = frozenset()
    disbelieved: tuple[tuple[MapId, str], ...] = ()


@dataclass(frozen=True)
class KeptPruning:
    """What a server keeps on its disk of superseded nodes, see mapweave.mapserver.merging.pruning.

    Attributes:
        links: marginal links.
        standing: verified links that are not decided again, by their nodes.
        since: superseded nodes, and since when, ns since 1970.
        linked_since: the nodes of verified links, and since when they hold.
        looked_ns: when it was last looked whether any had to go.
        parts: how many `KeptPruned` there are.
    """

    links: tuple[Linked, ...] = ()
    standing: tuple[tuple[NodeId, NodeId], ...] = ()
    since: tuple[tuple[NodeId, Stamp], ...] = ()
    linked_since: tuple[tuple[NodeId, NodeId, Stamp], ...] = ()
    looked_ns: Stamp = 0
    parts: int = 0


@dataclass(frozen=True)
class KeptPruned:
    """What is left of some nodes that were pruned.

    Attributes:
        nodes: each with what is left.
    """

    nodes: tuple[tuple[NodeId, PrunedNode], ...] = ()


VIEW = Limit("view", MAX_LANDMARKS_BYTES + 256)
LIMITS: dict[type, Limit] = {
    RelocalizeAnswer: Limit("relocalization", MAX_CANDIDATES * 512 + 2**13),
    RouteRequest: Limit("route request", 2**16),
    # 16 kB a leg; a node takes about 3 kB.
    RouteAnswer: Limit("route", 2**23),
    ReserveRequest: Limit("reserve request", 2**16),
    ReserveAnswer: Limit("reservation", 2**14),
    NearbyRequest: Limit("nearby request", 2**12),
    NearbyAnswer: Limit("nearby robots", 2**14),
    KnownRequest: Limit("known request", 256),
    KnownAnswer: Limit("known", 16 * MAX_KNOWN + 2**13),
    ExplainRequest: Limit("explain request", 2**16),
    PairExplanation: Limit("explanation", 2 * MAX_BODY_BYTES + 4_000_000, 200_000),
    FleetExplanation: Limit("explanation", 8_000_000, 500_000),
    RouteExplanation: Limit("explanation of a route", 16_000_000, 200_000),
    # A link has up to 150 pairs of landmarks, a retirement up to 1000 nodes.
    ManualConstraint: Limit("manual constraint", 2**16, 8192),
    ConstraintRequest: Limit("manual constraint", 2**16, 8192),
    ConstraintList: Limit("manual constraints", 2**26, 2_000_000),
    Annotation: Limit("annotation", 2**16),
    AnnotationRequest: Limit("annotation", 2**16),
    Annotations: Limit("annotations", 2**26, 4_000_000),
    ResolveRequest: Limit("resolve request", 2**14),
    ResolveAnswer: Limit("resolved places", 2**16),
    History: Limit("history", 2**26, 1_000_000),
    AgentStatus: Limit("agent status", 2**15),
    DriveRequest: Limit("drive request", 512),
    DriveAnswer: Limit("drive answer", 2**15 + 256),
    # 300 values a robot: its mission may have 16 places on its way. A node of the way ahead is four.
    FleetStatus: Limit("fleet status", 2**24, (300 + 4 * MOST_AHEAD) * MAX_ROBOTS),
    MissionOrder: Limit("mission", 4096),
    MissionReport: Limit("mission report", 2**15),
    MissionRequest: Limit("mission request", 4096),
    Missions: Limit("missions", 2**22, 50_000),
    PortalDone: Limit("portal done", 256),
    ViewRequest: Limit("request for a view", 256),
    ViewImage: Limit("view of a node", MAX_BYTES + 256),
    PlacedPlans: Limit("plans", 2**24, 1_000_000),
    PlanPiece: Limit("piece of a plan", PIECE + 1024),
    PlanReceived: Limit("plan image", 2048),
    KeptHistory: Limit("history", 2**26, 2_000_000),
    KeptPruning: Limit("record of pruning", 2**28, 20_000_000),
    KeptPruned: Limit("record of pruned nodes", 2**28, 20_000_000),
}
"""Kinds of messages."""


def encode(message: Any) -> bytes:
    """Encode a message; raises InvalidValue if it would not decode."""
    return typed.encode(message, LIMITS[type(message)])


def decode(data: bytes, kind: type[Value]) -> Value:
    """Decode a message; raises InvalidMessage."""
    return typed.decode(data, kind, LIMITS[kind])


def decode_explanation(data: bytes, request: ExplainRequest) -> Explanation:
    """Decode what answers a request for an explanation; raises InvalidMessage."""
    if request.route:
        return decode(data, RouteExplanation)
    if request.ends is not None and isinstance(request.ends[0], NodeId):
        return decode(data, PairExplanation)
    return decode(data, FleetExplanation)


class _View(msgspec.Struct):
    camera: bytes
    features: bytes
    near: tuple[str, int, int] | None = None


def encode_view(view: View) -> bytes:
    """Encode a view; raises InvalidValue if it would not decode."""
    fields: dict[str, object] = {
        "camera": pack_camera(view.camera),
        "features": pack_features(view.pixels, view.codes, view.camera),
    }
    if view.near is not None:
        fields["near"] = [*view.near]
    return pack(fields)


def decode_view(data: bytes) -> View:
    """Decode a view; raises InvalidMessage."""
    view: _View = unpack(data, _View, VIEW)
    camera = unpack_camera(view.camera)
    try:
        near = None if view.near is None else typed.value_of([*view.near], NodeId)
    except InvalidValue as error:
        raise InvalidMessage(f"view: near: {error}") from None
    return View(*unpack_features(view.features, camera), camera, near)
