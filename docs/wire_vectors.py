"""Test vectors of `wire.md`: every message with its key, its bytes in hexadecimal and its value.

python -m docs.wire_vectors    # writes docs/wire_vectors.json
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.drivers.messages import (
    StepRequest,
    decode_description,
    decode_observation,
    decode_step,
    encode_description,
    encode_observation,
    encode_step,
)
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap import annotation, constraint_subject, explanation, floor_plan, nearby, query
from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, HandDrive, RobotEntry, Status
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.descriptor import encode as encode_descriptors
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.drive_request import DriveAnswer, DriveRequest
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.landmark_tables import landmark_tables
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest, ManualConstraint
from mapweave.hybridmap.map_event import History, MapEvent, MapEventKind
from mapweave.hybridmap.mission_order import (
    MissionKind,
    MissionOrder,
    MissionReport,
    MissionRequest,
    Missions,
    MissionState,
)
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.portal import Portal, PortalDone, PortalMeans, PortalStop, PortalWait
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.superseded import Superseded
from mapweave.hybridmap.trajectory_segment import TrajectorySegment
from mapweave.hybridmap.view_image import ViewImage, ViewRequest
from mapweave.storage.map_file import MapFile, RefusedPair, pack_map_file, unpack_map_file
from mapweave.vision.equidistant import Equidistant
from mapweave.wire.codec import decode_change, encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import (
    Ack,
    Head,
    KeptNodes,
    LogAnswer,
    LogRequest,
    Mark,
    NewestMap,
    Refusal,
    StoredChange,
    decode_record,
    encode_record,
)
from mapweave.wire.messages import decode, decode_view, encode, encode_view
from mapweave.wire.pose_messages import MergedPose, PoseNews
from mapweave.wire.refusal import decode_refusal, encode_refusal
from synthetic.world import random_vectors

FILE = Path(__file__).with_suffix(".json")
KEYS = Keys("demo")
MAP, OTHER = MapId("r0", 3), MapId("r1", 1)
NODE, NEXT, FAR = NodeId("r0", 3, 17), NodeId("r0", 3, 18), NodeId("r1", 1, 5)
STAMP = 1_700_000_000_123_456_789
SMALL = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25, 0.05)
LARGE = Camera(8192, 4320, 5000.0, 5000.0, 4095.5, 2159.5, 1.5, 0.0)
HERE = PoseGaussian.from_sigmas(Pose2(1.25, -2.0, 0.5), 0.25, 0.125)
THERE = PoseGaussian(Pose2(0.5, 0.1, -0.2), np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.0], [0.5, 0.0, 2.0]]))


def vector(what: str, note: str, key: str, data: bytes, value: Any) -> dict[str, Any]:
    """One example: a class of the page or what it calls the message, what is special, where it travels."""
    return {"what": what, "note": note, "key": key, "hex": data.hex(), "value": shown(value)}


def shown(value: Any) -> Any:
    """A value as plain data of JSON: fields by their names, NaN as null, bytes as hexadecimal digits."""
    match value:
        case Pose2():
            return [value.x, value.y, value.heading]
        case NodePut(node):
            return shown(node)
        case EdgePut(edge):
            return shown(edge)
        case Enum():
            return value.value
        case bytes():
            return value.hex()
        case float():
            return None if math.isnan(value) else value
        case np.ndarray() | np.generic():
            return shown(value.tolist())
        case MapId() | NodeId():
            return list(value)
        case msgspec.Struct():
            return {name: shown(getattr(value, name)) for name in value.__struct_fields__}
        case Mapping() if any(not isinstance(key, str) for key in value):
            return [[shown(key), shown(element)] for key, element in value.items()]
        case Mapping():
            return {key: shown(element) for key, element in value.items()}
        case list() | tuple():
            return [shown(element) for element in value]
    if is_dataclass(value):
        tag = {"kind": value.TAG} if hasattr(value, "TAG") else {}
        return tag | {field.name: shown(getattr(value, field.name)) for field in fields(value)}
    return value


def landmarks(camera: Camera, count: int, by_rows: bool = True) -> Landmarks:
    """Landmarks as a robot makes them, with and without depth; by rows, or in another order."""
    random = np.random.default_rng(count)
    depths = random.uniform(0.3, 8.0, count).astype(np.float32)
    depths[::3] = np.nan
    pixels = (random.uniform(0, 1, (count, 2)) * [camera.width - 1, camera.height - 1]).astype(np.float32)
    sigmas = (depths * random.uniform(0.01, 0.5, count)).astype(np.float32)
    settled, _ = settle(Landmarks(pixels, quantise(random_vectors(count, random)), depths, sigmas), camera)
    return settled if by_rows else settled.take(np.arange(count)[::-1])


LIFT = PortalStop("east lift", PortalMeans.LIFT, NODE, FAR, "second", "key at the desk")


def node(node_id: NodeId = NODE, count: int = 3, camera: Camera = SMALL, by_rows: bool = True) -> Node:
    """One with nothing that may be left out."""
    return Node(node_id, STAMP, HERE, camera, landmarks(camera, count, by_rows))


def full_node() -> Node:
    """One with everything."""
    ranges = Ranges(np.array([0.7854, 0.0, -0.7854]), np.array([0.4, 1.66, 1.0]), 1.66)
    segment = TrajectorySegment(
        np.array([-0.2, 0.3]), np.array([[-0.04, 0.001, 0.02], [0.06, 0.0, -0.03]]),
        np.array([[0.5, 1.66, 1.1], [0.3, 1.5, 1.66]]),
    )  # fmt: skip
    return Node(NODE, STAMP, HERE, SMALL, landmarks(SMALL, 5), "utc", 0.16, ranges, segment)


def edge(wide: bool = False) -> Edge:
    """Between two nodes of one map; a wide one has indices above 255, and an end in another map."""
    shared = np.array([[0, 2], [1, 300]] if wide else [[0, 2], [1, 0], [2, 1]])
    kind = EdgeKind.DRIVEN if wide else EdgeKind.MAPPED
    evidence = {"there": 2.0, "back": 1.0, "inliers": 41.0} if wide else {"inliers": 43.0, "rms_px": 0.625}
    return Edge(NodeId(*MAP, 19), NODE, FAR if wide else NEXT, THERE, kind, shared, evidence)


def constraints() -> tuple[ManualConstraint, ...]:
    """One of every kind."""
    subjects = (
        constraint_subject.Apart((MAP, OTHER)),
        constraint_subject.Apart((NODE, FAR)),
        constraint_subject.Linked(
            NODE, FAR, Pose2(0.5, -0.25, 0.125), (0.25, 0.0, 0.0, 0.25, 0.0, 0.0625), ((0, 2), (1, 0)),
            (("inliers", 12.0), ("rms_px", 0.5)),
        ),
        constraint_subject.RetiredMap(OTHER),
        constraint_subject.RetiredNodes((NODE, NEXT)),
        constraint_subject.RetiredArea(Area(NODE, ((0.0, 0.0), (4.0, 0.0), (4.0, 2.5)))),
        constraint_subject.RetiredWindow(MAP, 5, STAMP),
    )  # fmt: skip
    return tuple(
        ManualConstraint(one, k != 3, "anna", STAMP + k, "two kitchens") for k, one in enumerate(subjects)
    )


def annotations() -> tuple[annotation.Annotation, ...]:
    """One of every kind."""
    image = floor_plan.PlanImage("0f" * 32, 760, 800, "office.png")
    pairs = tuple(floor_plan.PlanPair(NODE, 0.0, float(k), 100.5 * k, 340.0) for k in range(3))
    bodies = {
        "kitchen": annotation.Place(NODE),
        "hall": annotation.Place(area=Area(NODE, ((0.0, 0.0), (4.0, 0.0), (4.0, 2.5)))),
        "paint": annotation.Closure((NODE, NEXT), begin_ns=STAMP),
        "corridor": annotation.Preference(0.5, (NODE, FAR)),
        str(MAP): annotation.Floor(NODE, "ground"),
        "east lift": Portal(NODE, FAR, PortalMeans.LIFT, "key at the desk"),
        "office": floor_plan.FloorPlan(pairs, image, 0.025, Pose2(-1.0, 2.0, 0.0)),
        "frame": Pin(NODE, Pose2(12.5, -3.0, 1.5)),
    }
    return tuple(
        annotation.Annotation(name, body, name == "paint", "anna", STAMP, "") for name, body in bodies.items()
    )


def plan(record: tuple[annotation.Annotation, ...]) -> floor_plan.PlacedPlan:
    """A plan under a component."""
    given = next(entry.body for entry in record if isinstance(entry.body, floor_plan.FloorPlan))
    pair = floor_plan.FittedPair(1, NODE, (0.5, -0.25), (0.5, -0.125), 0.125, 0.25, 0.5)
    part = floor_plan.PlanPart(
        0, Pose2(6.5, 11.75, 1.5), 0.025, (0.025, 0.0, 0.0, -0.025, 1.0, 20.0),
        tuple(float(k) for k in range(16)), 0.0625, 0.125, (pair,), 0.024, 0.5, ("pair 1 is far off",),
    )  # fmt: skip
    return floor_plan.PlacedPlan("office", given, (part,), "2 pairs are left out")


def status() -> AgentStatus:
    """The status of a robot that drives to a goal."""
    pipeline = Status(
        "driving to the goal", "3 nodes to go", 17, 40, HERE.mean, False, "goto", NODE, Pose2(0.1, 0.0, 0.25),
        5, progress=0.25, drive=DriveStatistics(4, 1, 1, 0), covariance=(0.25, 0.0, 0.25, 0.0625),
    )  # fmt: skip
    return AgentStatus(
        pipeline,
        STAMP,
        "r0",
        3,
        2,
        123456,
        True,
        15,
        mission(),
        0.75,
        "map server s0 is gone",
        2.5,
        3,
        HandDrive("anna", STAMP, True),
    )


def mission() -> MissionReport:
    """A drive to a place."""
    order = MissionOrder(
        "7f3a9c", "r0", MissionKind.GO, STAMP, "anna", FAR, "kitchen", (NODE,), "a guest waits"
    )
    wait = PortalWait(LIFT, 2, True)
    return MissionReport(order, MissionState.RUNNING, 0.25, "driving", 1, wait)


def explained() -> explanation.PairExplanation:
    """Two nodes that are linked."""
    matches = np.array([[0, 2], [1, 0], [2, 1]])
    misfit = explanation.Misfit(HERE, np.array([0.1, 0.2, -0.3]), 4.5, False)
    other = explanation.LinkAgreement(NODE, FAR, 2.5, True, False)
    return explanation.PairExplanation(
        node(), node(FAR), explanation.Standing.LINKED, "by 2 landmarks", matches, matches[:2],
        np.array([0.5, math.nan]), HERE, {"inliers": 12.0, "rms_px": 0.5}, 0.875, misfit, (other,),
        ("r0 has recognised it",), constraints()[:1],
    )  # fmt: skip


def maps_explained() -> explanation.MapsExplanation:
    """Two maps that are one over a third."""
    near = explanation.NearMiss(NODE, FAR, 20, 5, "15 landmarks would have to agree")
    return explanation.MapsExplanation(
        MAP, OTHER, True, "over another", 0, 0, 1, 3, (near,), constraints()[:1], (MapId("r2", 1),)
    )


def map_file() -> MapFile:
    """A merged map with something in every field."""
    first, second = full_node(), node(FAR)
    hop = Edge(
        NodeId("merge", 0, 1), NODE, FAR, THERE, EdgeKind.MERGED, np.array([[0, 1]]), {"probability": 0.875}
    )
    return MapFile(
        "merged", "three rooms", (NodePut(first), NodePut(second), EdgePut(hop)),
        {NODE: (0, HERE), FAR: (0, THERE)},
        (RefusedPair(NODE, FAR, "a set of links contradicts it", edge()), RefusedPair(NEXT, FAR, "chance")),
        constraints(), {FAR: Superseded(NODE, 34, 0.25, -0.5)}, {FAR: np.array([True, False, True])},
        (MapEvent(STAMP, MapEventKind.JOINED, "r0.3 and r1.1 are one map now, by 4 links"),),
        annotations(), {FAR: 4}, {"0f" * 32: b"\x89PNG"},
        {FAR.map: "change 9 is refused (edge r1.1.4 is 99000 m long, more than 1000 m)"},
    )  # fmt: skip


def answers() -> dict[str, tuple[Any, ...]]:
    """Values that travel under their fields' names, by the end of their keys."""
    legs = (query.RouteLeg(node(), THERE, None), query.RouteLeg(node(FAR), THERE, EdgeKind.LOOP))
    where = query.Whereabouts(FAR, HERE, THERE, 0, 41, 0.75, True, "kitchen", "ground")
    similar = query.SimilarPlace(FAR, 20, 5, 15, "15 landmarks would have to agree", -0.5)
    hop = explanation.Hop(NODE, FAR, "merged", 0.5, 0.25, 1.5, "the servo drives along it")
    views = np.array([[1.5, -2.0, 0.5, 0.75], [3.0, 0.0, -1.5, 0.5]], np.float32)
    image = floor_plan.PlanImage("0f" * 32, 760, 800, "office.png")
    request = MissionRequest(
        "7f3a9c", "r0", MissionKind.GO, STAMP, "anna", "kitchen", ("r0.3.17",), "a guest waits"
    )
    obstacle = query.Obstacle(NEXT, 0.25, -0.5, 0.375, "r1")
    route = query.RouteRequest(NODE, FAR, ((NODE, NEXT),), Pose2(0.1, 0.0, 0.2), (obstacle,))
    robots = (
        RobotEntry(
            "r0", True, 0.5, status(), Pose2(1.0, 2.0, 3.0), 0, "kitchen", "ground", ahead=(NEXT, FAR)
        ),
        RobotEntry(
            "r9", False, missing=3, lag=1.5, newest=FAR, links=2, apart="1 link was found and refused"
        ),
    )
    return {
        "server/s0/relocalize": (
            query.RelocalizeAnswer(query.Certainty.FOUND, (where,), "41 landmarks agree"),
            query.RelocalizeAnswer(
                query.Certainty.UNKNOWN, (), "no place agrees", (similar,), "1 of 4 shards did not answer"
            ),
        ),
        "server/s0/route": (
            route,
            query.RouteAnswer(legs, "2 nodes"),
            query.RouteAnswer(legs, "", LIFT, "r1 stands on a shorter way"),
        ),
        "server/s0/known": (query.KnownRequest(MAP, 1.25, -2.5, 8.5), query.KnownAnswer(views, "2 views")),
        "server/s0/reserve": (
            query.ReserveRequest("r0", NODE, Pose2(0.1, 0.0, 0.2), (NEXT, FAR)),
            query.ReserveAnswer(1, "r1", FAR, "r1 drives there", True, True),
        ),
        "server/s0/nearby": (
            nearby.NearbyRequest(
                "r0", ((NODE, Pose2(0.1, 0.0, 0.2)), (NEXT, Pose2())), 0.05, 0.01, 0.16, 0.3, 0.3
            ),
            nearby.NearbyAnswer(
                (nearby.NearbyRobot("r1", Pose2(1.5, -0.25, 3.0), 0.125, 0.16, 0.3, 0.3, 0.5),), "", FAR
            ),
        ),
        "server/s0/explain": (
            query.ExplainRequest((NODE, FAR), True, ((NODE, NEXT),)),
            query.ExplainRequest((MAP, OTHER)),
            query.ExplainRequest(),
            explained(),
            explanation.FleetExplanation((maps_explained(),), ("map r1.1 is set apart: copies",)),
            explanation.RouteExplanation(NODE, FAR, True, "by 1 edge", (hop,), (hop,), maps_explained()),
        ),
        "server/s0/constrain": tuple(ConstraintRequest(one, k == 2) for k, one in enumerate(constraints())),
        "server/s0/constraints": (ConstraintList(constraints()),),
        "server/s0/annotate": tuple(
            annotation.AnnotationRequest(one, k == 2) for k, one in enumerate(annotations())
        ),
        "server/s0/annotations": (annotation.Annotations(annotations()),),
        "server/s0/resolve": (
            query.ResolveRequest(("r0.3.17", "kitchen", "3.1,-2.0"), "kitchen", 2.0),
            query.ResolveAnswer((query.Resolved(NODE, Pose2(1.0, 2.0, 0.5), 0, "kitchen", "the nearest"),)),
        ),
        "server/s0/history": (History((MapEvent(STAMP, MapEventKind.KEPT_APART, "r0.3 and r1.1"),)),),
        "server/s0/plans": (floor_plan.PlacedPlans((plan(annotations()),)),),
        "server/s0/put_plan_image": (
            floor_plan.PlanPiece("0f" * 32, 4, 0, b"\x89PNG"),
            floor_plan.PlanReceived(4, image),
        ),
        "server/s0/mission": (request,),
        "server/s0/missions": (Missions((mission(),)),),
        "server/s0/robots": (FleetStatus(robots),),
        "agent/r0/mission": (mission().order, mission()),
        "agent/r0/status": (status(),),
        "agent/r0/view": (ViewRequest(NODE), ViewImage(NODE, b"\xff\xd8\xff\xd9")),
        "agent/r0/portal": (PortalDone("r0", "anna"),),
        "agent/r0/drive": (
            DriveRequest(7, 0.25, -0.5, STAMP, True, "anna"), DriveAnswer(status(), STAMP, 0.5, 0.75),
        ),
    }  # fmt: skip


def changes() -> list[dict[str, Any]]:
    """Nodes and edges, and the messages around a log."""
    notes: tuple[tuple[str, NodePut | EdgePut | NodeRetired | EdgeRetired], ...] = (
        ("node put, landmarks by rows", NodePut(node())),
        ("node put with ranges, trajectory, radius and clock", NodePut(full_node())),
        ("node put, landmarks not by rows", NodePut(node(count=4, by_rows=False))),
        ("node put of a large image: pixels in quarters", NodePut(node(count=4, camera=LARGE))),
        ("node put without landmarks", NodePut(node(count=0))),
        ("edge put", EdgePut(edge())),
        ("edge put to another map, indices of two bytes", EdgePut(edge(wide=True))),
        ("node retired", NodeRetired(NODE)),
        ("edge retired", EdgeRetired(NodeId(*MAP, 19))),
    )
    made = [encode_change(Change(MAP, 1000 + k, STAMP + k, body)) for k, (_, body) in enumerate(notes)]
    vectors = [
        vector("change", note, KEYS.change(MAP), data, decode_change(data))
        for (note, _), data in zip(notes, made, strict=True)
    ]
    small: tuple[tuple[str, str, Any], ...] = (
        ("beacon", KEYS.head(MAP), Head(2**63, 1008, {"s0": 1000, "s1": 1008})),
        ("log question", KEYS.log(MAP), LogRequest(1003, 1008)),
        ("log question", KEYS.log(MAP), LogRequest(1003, 1008, StoredChange(1001, 7))),
        ("log answer", KEYS.log(MAP), LogAnswer(2**63, 1003, 1008, ((1007, made[7]), (1008, b"")))),
        ("acknowledgement", KEYS.ack("s0", "r0"), Ack(MAP, 2**63, 1005, (Refusal(1004, "none"),), 77, 2.5)),
        ("acknowledgement", KEYS.ack("s0", "r0"), Ack(MAP, 5, 1005, stored=StoredChange(1003, 2**32 - 1))),
        ("newest map", KEYS.ack("s0", "r0"), NewestMap(3)),
        ("kept nodes", KEYS.ack("s0", "r0"), KeptNodes(2, (1, 4, 1000))),
        ("newest map", KEYS.ack("s0", "r0"), NewestMap(3, pruned=True)),
    )  # fmt: skip
    vectors += [
        vector(what, "", key, one.encode(), type(one).decode(one.encode())) for what, key, one in small
    ]
    mark = Mark(1000, 2**63).encode()
    return [*vectors, vector("attachment", "of a change", KEYS.change(MAP), mark, Mark.decode(mark))]


def _sensed(data: bytes) -> dict[str, Any]:
    """An observation as it is sent."""
    found = shown(decode_observation(data))
    return {name: value for name, value in found.items() if name not in ("left_out", "silent")}


def _refusal(data: bytes) -> Any:
    reply = decode_refusal(data)
    assert reply is not None
    return {"error": reply.error, "retry_after": reply.retry_after}


def descriptors() -> list[dict[str, Any]]:
    """SIFT, a byte an entry, and its code: usual ones, an empty one, and the farthest ones."""
    usual = np.minimum(np.random.default_rng(3).gamma(0.5, 45.0, (3, 128)), 255.0)
    basis = landmark_tables().basis
    # RootSIFT along an axis reaches farthest, as far as it may: no entry is negative.
    least, largest = np.maximum(-basis[:, 0], 0.0) ** 2, np.maximum(basis[:, 0], 0.0) ** 2
    extremes = [255.0 * row / row.max() for row in (least, largest)]
    rows = np.round([*usual, np.zeros(128), *extremes]).astype(np.uint8)
    notes = ("", "", "", "an empty one", "far along an axis", "far along an axis")
    codes = encode_descriptors(rows)
    return [
        vector("descriptor", note, "", row.tobytes(), code)
        for note, row, code in zip(notes, rows, codes, strict=True)
    ]


def others() -> list[dict[str, Any]]:
    """Messages with a form of their own, robot bases, and a map file."""
    placed = {NODE: MergedPose(NODE, Pose2(1.25, -2.0, 0.5)), NEXT: MergedPose(FAR, Pose2(0.5, 0.0, -1.5))}
    news = PoseNews(2**62, 4, 5, placed, (NodeId("r0", 2, 3),))
    seen = landmarks(SMALL, 4, by_rows=False)
    view = query.View(seen.pixels, seen.codes, SMALL)
    near = query.View(seen.pixels, seen.codes, SMALL, NODE)
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    observation = Observation(STAMP, Odometry(0.025, -0.05), image, np.array([0.4, 1.5]), True, 0.75, True)
    geometry = DriveGeometry(wheel_scale=1.02, drift=0.01, heading=0.02, delay=0.03)
    fisheye = Equidistant(160.0, 160.0, 159.5, 119.5, (0.01, -0.002, 0.0, 0.0))
    wide = RobotDescription(SMALL, fisheye, clock="utc", geometry=geometry)
    webcam = RobotDescription(
        SMALL, (-0.3, 0.1, 0.0, 0.0, 0.0), ranger_bearings=(0.5, -0.5), ranger_reach=1.5
    )
    answer: dict[str, bool | int | float | str] = {"said": "r0.3.17 and r1.1.5 are linked"}
    cases: tuple[tuple[str, str, str, bytes, Callable[[bytes], Any]], ...] = (
        ("merged poses", "", "server/s0/poses/r0", news.encode("r0"), lambda d: PoseNews.decode(d, "r0")),
        ("view", "question", "server/s0/relocalize", encode_view(view), decode_view),
        ("view", "of a known floor", "server/s0/relocalize", encode_view(near), decode_view),
        ("flat record", "answer", "server/s0/constrain", encode_record(answer), decode_record),
        ("refusal", "error reply", "server/s0/route", encode_refusal("no such node", 0.0), _refusal),
        ("refusal", "error reply of a busy server", "server/s0/route", encode_refusal("busy", 0.5), _refusal),
        ("RobotDescription", "answer", "robot/b0/describe", encode_description(webcam), decode_description),
        ("RobotDescription", "fisheye", "robot/b0/describe", encode_description(wide), decode_description),
        ("step question", "", "robot/b0/step", encode_step(StepRequest(7, Command(0.25, -0.5))), decode_step),
        ("step answer", "raw image", "robot/b0/step", encode_observation(observation), _sensed),
        ("map file", "the answer, and a file", "server/s0/map", pack_map_file(map_file()), unpack_map_file),
    )  # fmt: skip
    return [
        vector(what, note, f"{KEYS.root}/{key}", data, read(data)) for what, note, key, data, read in cases
    ]


def vectors() -> list[dict[str, Any]]:
    """All of them."""
    values = [
        vector(type(one).__name__, "", f"{KEYS.root}/{key}", encode(one), decode(encode(one), type(one)))
        for key, ones in answers().items()
        for one in ones
    ]
    return [*changes(), *values, *others(), *descriptors()]


def as_json() -> str:
    """The file: one line for each."""
    lines = ",\n".join(json.dumps(one, separators=(",", ":")) for one in vectors())
    return f"[\n{lines}\n]\n"


if __name__ == "__main__":
    FILE.write_text(as_json(), encoding="utf-8")
