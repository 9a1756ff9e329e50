"""Ways in which a robot lies. Each makes a log of legal messages out of the robot's own map and the others'.

What no encoder writes is packed by hand: a robot that is taken over need not use ours.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import msgpack
import numpy as np

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.descriptor import decode, quantise
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.landmark_tables import DIMENSIONS
from mapweave.hybridmap.limits import MAX_LANDMARKS, MAX_NUMBER
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.registration.matching import match
from mapweave.wire.codec import encode_body, encode_change, wrap_body
from mapweave.wire.pose_codec import MAX_MEASURED, MAX_VARIANCE, POSTURE, UPPER

Map = tuple[list[Node], list[Edge]]
Logs = dict[MapId, list[bytes]]
SURE = np.diag([0.015, 0.015, 0.008]) ** 2
"""Covariance of an edge that looks well measured, m^2 and rad^2."""
OFF_M = 2.0
"""By which copied places are torn apart."""
EPOCHS = 40
"""Maps of the robot that begins a new one for every few nodes."""
ALTERED_PIXEL, ALTERED_CODE, ALTERED_DEPTH = 0.7, 0.04, 0.03
"""By how much two views of a landmark differ: standard deviations, px, of a decoded descriptor's coordinates,
and of the depth as a share of it."""
ASIDE, MISSED, NEAREST = (0.15, 0.15, 0.1), 0.3, 0.3
"""How far aside, standard deviations in m, m and rad; which share of the landmarks is missed; from which
depth on they are seen, m."""
SCALE, DEEPER, LENSES = 1.05, 1.3, (0.7, 1.5)
"""By how many times lengths, depths and focal lengths are wrong."""
CODE_SIGMA = 0.12
"""Of the coordinates of decoded descriptors that belong to nothing: norms are then those of real ones."""


@dataclass(frozen=True, eq=False)
class LyingMessages:
    """The messages that a lying robot sends.

    Attributes:
        logs: the changes of each of its maps.
        first: sequence number of the first change.
        extra: messages that it publishes besides, with their sequence number.
    """

    logs: Logs
    extra: Sequence[tuple[MapId, int, bytes]] = field(default=())


@dataclass(frozen=True, eq=False)
class LieInputs:
    """What a lie is made of.

    Attributes:
        map: of the robot that lies.
        own: its honest map.
        others: the maps of the others.
        rng: draws the rest.
    """

    map: MapId
    own: Map
    others: Mapping[MapId, Map]
    rng: np.random.Generator

    def id(self, number: int) -> NodeId:
        """The id of a node or an edge of the robot that lies."""
        return NodeId(*self.map, number)

    def theirs(self) -> list[Node]:
        """The nodes of the first two other maps, in turns: a copy ties one to the other."""
        first, second, *_ = (nodes for nodes, _ in self.others.values())
        return [node for pair in zip(first, second, strict=False) for node in pair]


def bodies(content: Map) -> list[ChangeBody]:
    """The changes of a map, in the order of a drive."""
    nodes, edges = content
    place = {node.id: k for k, node in enumerate(nodes)}
    after: dict[int, list[Edge]] = {}
    for edge in edges:
        after.setdefault(max(place.get(edge.a, 0), place.get(edge.b, 0)), []).append(edge)
    out: list[ChangeBody] = []
    for k, node in enumerate(nodes):
        out += [NodePut(node), *map(EdgePut, after.get(k, ()))]
    return out


def messages(map_id: MapId, changes: Sequence[ChangeBody]) -> list[bytes]:
    """Changes as their robot sends them."""
    return [encode_change(Change(map_id, k, 0, body)) for k, body in enumerate(changes, start=1)]


def chain(setting: LieInputs, nodes: Sequence[Node], poses: Sequence[Pose2], covariance: Array = SURE) -> Map:
    """Nodes at poses of one's choice, with the edges and the times that a drive would have."""
    out: list[Node] = []
    edges: list[Edge] = []
    for k, (node, pose) in enumerate(zip(nodes, poses, strict=True)):
        # The frame of a map is its first node's.
        at = PoseGaussian(poses[0].inverse() @ pose, SURE if k else np.zeros((3, 3)))
        stamp = setting.own[0][0].stamp_ns + 2_000_000_000 * k
        out.append(replace(node, id=setting.id(2 * k + 1), stamp_ns=stamp, map_from_robot=at))
        if k:
            step = PoseGaussian(poses[k - 1].inverse() @ pose, covariance)
            edges.append(Edge(setting.id(2 * k), out[-2].id, out[-1].id, step, EdgeKind.MAPPED))
    return out, edges


def raw_pose(pose: Pose2, covariance: Array) -> bytes:
    """A pose as bytes, whatever its numbers."""
    return POSTURE.pack(*pose.vector, *covariance[UPPER])


def forged(body: ChangeBody, **fields: object) -> bytes:
    """A body with fields that no encoder writes."""
    packed: bytes = msgpack.packb({**msgpack.unpackb(encode_body(body)), **fields})
    return packed


def honest(s: LieInputs) -> LyingMessages:
    """Nothing is false: what the others end with beside a fourth robot."""
    return LyingMessages({s.map: messages(s.map, bodies(s.own))})


def far_node(s: LieInputs) -> LyingMessages:
    """Every third node is at 1e9 m, by a message that no encoder writes."""
    log = []
    for k, body in enumerate(bodies(s.own), start=1):
        far = isinstance(body, NodePut) and k % 3 == 0
        fields = {"p": raw_pose(Pose2(1e9, 0.0, 0.0), SURE)} if far else {}
        log.append(wrap_body(k, 0, forged(body, **fields)))
    return LyingMessages({s.map: log})


def long_steps(s: LieInputs) -> LyingMessages:
    """Each edge is as long as a message allows."""
    nodes = s.own[0]
    return LyingMessages({s.map: messages(s.map, bodies(chain(
        s, nodes, [Pose2(0.0, 0.99 * MAX_MEASURED * (k % 2), 0.0) for k in range(len(nodes))]
    )))})  # fmt: skip


def covariance_of_zero(s: LieInputs) -> LyingMessages:
    """Steps a tenth too long, of which the robot is perfectly certain."""
    nodes, edges = s.own
    steps = [edge.a_from_b.mean for edge in edges]
    wrong = [
        replace(edge, a_from_b=PoseGaussian(Pose2(1.1 * step.x, 1.1 * step.y, step.heading), 0.0 * SURE))
        for edge, step in zip(edges, steps, strict=True)
    ]
    return LyingMessages({s.map: messages(s.map, bodies((nodes, wrong)))})


def covariance_of_1e12(s: LieInputs) -> LyingMessages:
    """Each edge has a covariance of 1e12 m^2."""
    log = []
    for k, body in enumerate(bodies(s.own), start=1):
        wide = {"p": raw_pose(body.edge.a_from_b.mean, 1e12 * np.eye(3))} if isinstance(body, EdgePut) else {}
        log.append(wrap_body(k, 0, forged(body, **wide)))
    return LyingMessages({s.map: log})


def greatest_covariance(s: LieInputs) -> LyingMessages:
    """Wrong steps, of each of which the robot knows nothing: the greatest covariance that a message holds."""
    nodes, _ = s.own
    poses = [Pose2.from_vector(s.rng.uniform(-50.0, 50.0, 3)) for _ in nodes]
    return LyingMessages(
        {s.map: messages(s.map, bodies(chain(s, nodes, poses, 0.99 * MAX_VARIANCE * np.eye(3))))}
    )


def contradicting_clocks(s: LieInputs) -> LyingMessages:
    """True views and a true way, at the very times at which another robot was at the same places."""
    first, *_ = (nodes for nodes, _ in s.others.values())
    nodes, edges = s.own
    stamps = [max(first, key=lambda other: alike(node, other)).stamp_ns for node in nodes]
    return LyingMessages({s.map: messages(s.map, bodies(([
        replace(node, stamp_ns=stamp) for node, stamp in zip(nodes, stamps, strict=True)
    ], edges)))})  # fmt: skip


def same_times(s: LieInputs) -> LyingMessages:
    """True views and a true way, with another robot's clock from first to last."""
    first, *_ = (nodes for nodes, _ in s.others.values())
    nodes, edges = s.own
    stamps = [first[min(k, len(first) - 1)].stamp_ns for k in range(len(nodes))]
    return LyingMessages({s.map: messages(s.map, bodies(([
        replace(node, stamp_ns=stamp) for node, stamp in zip(nodes, stamps, strict=True)
    ], edges)))})  # fmt: skip


def many_landmarks(s: LieInputs) -> LyingMessages:
    """Nodes with as many landmarks as fifty messages hold: 100 000, a few of them true."""
    nodes = [
        replace(node, landmarks=_filled(node, s.rng)) for node in (s.own[0] * math.ceil(50 / len(s.own[0])))
    ][:50]
    poses = [Pose2(0.3 * k, 0.0, 0.0) for k in range(len(nodes))]
    return LyingMessages({s.map: messages(s.map, bodies(chain(s, nodes, poses)))})


def edges_to_nowhere(s: LieInputs) -> LyingMessages:
    """Edges to nodes that do not exist, and between nodes of others, all of them certain and false."""
    own, log = [node.id for node in s.own[0]], bodies(s.own)
    theirs = [node.id for node in s.theirs()]
    ends = [*own, *theirs, s.id(10**6 + 1), NodeId("unknown", 0, 1)]
    for k in range(300):
        a, b = (ends[n] for n in s.rng.choice(len(ends), 2, replace=False))
        kind = list(EdgeKind)[k % len(EdgeKind)]
        pose = PoseGaussian(Pose2.from_vector(s.rng.uniform(-5.0, 5.0, 3)), SURE)
        log.append(EdgePut(Edge(s.id(10_001 + 2 * k), a, b, pose, kind, evidence={"inliers": 200.0})))
    return LyingMessages({s.map: messages(s.map, log)})


def greatest_sequence(s: LieInputs) -> LyingMessages:
    """A log that goes on at 2^53."""
    log = messages(s.map, bodies(s.own))
    last = encode_change(Change(s.map, MAX_NUMBER, 0, NodePut(s.own[0][0])))
    return LyingMessages({s.map: log[:5]}, ((s.map, MAX_NUMBER, last),))


def many_epochs(s: LieInputs) -> LyingMessages:
    """A new map for every few nodes, again and again, each with true views and wrong ways between them."""
    return _shuffled(s, EPOCHS, 3, 3)


def shuffled_maps(s: LieInputs) -> LyingMessages:
    """The same with more nodes a map, so that its geometry can be tested."""
    return _shuffled(s, EPOCHS // 2, 4, 9)


def copied_to_tear(s: LieInputs) -> LyingMessages:
    """Nodes of two others as they are, with wrong ways between them: each says that the two lie elsewhere."""
    return LyingMessages({s.map: messages(s.map, bodies(_torn(s, s.theirs())))})


def altered_to_tear(s: LieInputs) -> LyingMessages:
    """The same, each copy altered as much as another view would differ."""
    return LyingMessages(
        {s.map: messages(s.map, bodies(_torn(s, [altered(node, s.rng) for node in s.theirs()])))}
    )


def copied_places(s: LieInputs) -> LyingMessages:
    """Nodes of others as they are, behind the end of the own drive: their places would be elsewhere."""
    return LyingMessages({s.map: messages(s.map, bodies(_captured(s, s.theirs())))})


def altered_places(s: LieInputs) -> LyingMessages:
    """The same, each copy altered as much as another view would differ."""
    return LyingMessages(
        {s.map: messages(s.map, bodies(_captured(s, [altered(node, s.rng) for node in s.theirs()])))}
    )


def places_from_aside(s: LieInputs) -> LyingMessages:
    """The same, each copy as it would look from a little aside, with some of its landmarks."""
    seen = [seen_from_aside(node, s.rng) for node in s.theirs()]
    return LyingMessages({s.map: messages(s.map, bodies(_captured(s, seen)))})


def mixed_landmarks(s: LieInputs) -> LyingMessages:
    """The own map, with half of each node's landmarks taken from others' nodes."""
    theirs, nodes = s.theirs(), []
    for k, node in enumerate(s.own[0]):
        other = theirs[(k * 3) % len(theirs)]
        some = [half.landmarks.take(np.arange(0, len(half.landmarks), 2)) for half in (node, other)]
        nodes.append(replace(node, landmarks=joined(some)))
    # What landmarks an edge's ends share would give it away.
    edges = [replace(edge, shared=edge.shared[:0]) for edge in s.own[1]]
    return LyingMessages({s.map: messages(s.map, bodies((nodes, edges)))})


def scaled_way(s: LieInputs) -> LyingMessages:
    """True views, with way and depths 5 % too long: as by wheels of another size."""
    nodes = [_with_depths(node, SCALE) for node in s.own[0]]
    poses = [_scaled(node.map_from_robot.mean) for node in nodes]
    edges = [
        replace(edge, a_from_b=PoseGaussian(_scaled(edge.a_from_b.mean), edge.a_from_b.covariance))
        for edge in s.own[1]
    ]
    placed = [
        replace(node, map_from_robot=PoseGaussian(pose, node.map_from_robot.covariance))
        for node, pose in zip(nodes, poses, strict=True)
    ]
    return LyingMessages({s.map: messages(s.map, bodies((placed, edges)))})


def wrong_depths(s: LieInputs) -> LyingMessages:
    """A true way and true views, but for depths that are 30 % too long."""
    nodes = [_with_depths(node, DEEPER) for node in s.own[0]]
    return LyingMessages({s.map: messages(s.map, bodies((nodes, s.own[1])))})


def other_lenses(s: LieInputs) -> LyingMessages:
    """A true way and true views, by focal lengths that are too short and too long in turns."""
    nodes = []
    for k, node in enumerate(s.own[0]):
        camera, by = node.camera, LENSES[k % 2]
        nodes.append(replace(node, camera=replace(camera, fx=by * camera.fx, fy=by * camera.fy)))
    return LyingMessages({s.map: messages(s.map, bodies((nodes, s.own[1])))})


def altered(node: Node, rng: np.random.Generator) -> Node:
    """A node as another view from the same place would be."""
    marks = node.landmarks
    pixels = marks.pixels + rng.normal(0.0, ALTERED_PIXEL, marks.pixels.shape)
    pixels = np.clip(pixels, 0.0, [node.camera.width - 1.0, node.camera.height - 1.0])
    vectors = decode(marks.codes)
    codes = quantise(vectors + rng.normal(0.0, ALTERED_CODE, vectors.shape))
    depths = marks.depths * (1.0 + rng.normal(0.0, ALTERED_DEPTH, len(marks)))
    return replace(
        node, landmarks=Landmarks(
            pixels.astype(np.float32), codes, depths.astype(np.float32), marks.depth_sigmas
        )
    )  # fmt: skip


def seen_from_aside(node: Node, rng: np.random.Generator) -> Node:
    """A node as a view from a little aside would be, by the depths of its landmarks; some are missed."""
    marks, camera = node.landmarks, node.camera
    x, y, heading = rng.normal(0.0, ASIDE)
    slope = (marks.pixels[:, 0] - camera.cx) / camera.fx
    ahead, left = marks.depths + camera.mount_forward - x, -slope * marks.depths - y
    cos, sin = np.cos(heading), np.sin(heading)
    depths = cos * ahead + sin * left - camera.mount_forward
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = camera.cx + camera.fx * (sin * ahead - cos * left) / depths
        rows = camera.cy + (marks.pixels[:, 1] - camera.cy) * marks.depths / depths
    inside = (columns >= 0.0) & (columns < camera.width) & (rows >= 0.0) & (rows < camera.height)
    kept = np.flatnonzero(inside & (depths > NEAREST) & (rng.random(len(marks)) > MISSED))
    pixels = np.stack([columns, rows], axis=1)[kept].astype(np.float32)
    sigmas = marks.depth_sigmas[kept]
    seen = Landmarks(pixels, marks.codes[kept], depths[kept].astype(np.float32), sigmas)
    return altered(replace(
        node, landmarks=seen, map_from_robot=node.map_from_robot @ PoseGaussian(Pose2(x, y, heading), SURE)
    ), rng)  # fmt: skip


def alike(a: Node, b: Node) -> int:
    """How many landmarks of two nodes match."""
    return len(match(a.landmarks.codes, b.landmarks.codes))


def joined(some: Sequence[Landmarks]) -> Landmarks:
    """All of several."""
    columns = zip(*((one.pixels, one.codes, one.depths, one.depth_sigmas) for one in some), strict=True)
    return Landmarks(*(np.concatenate(column) for column in columns))


def _scaled(pose: Pose2) -> Pose2:
    return Pose2(SCALE * pose.x, SCALE * pose.y, pose.heading)


def _with_depths(node: Node, factor: float) -> Node:
    """A node whose landmarks are so many times as far away, as well known as they were."""
    marks = node.landmarks
    depths, sigmas = ((factor * column).astype(np.float32) for column in (marks.depths, marks.depth_sigmas))
    return replace(node, landmarks=Landmarks(marks.pixels, marks.codes, depths, sigmas))


def _filled(node: Node, rng: np.random.Generator) -> Landmarks:
    """A node's landmarks behind as many of no place as a message holds."""
    count = MAX_LANDMARKS - len(node.landmarks)
    pixels = rng.uniform(0.0, [node.camera.width, node.camera.height], (count, 2)).astype(np.float32)
    depths = rng.uniform(0.5, 6.0, count).astype(np.float32)
    more = Landmarks(
        pixels, quantise(rng.normal(0.0, CODE_SIGMA, (count, DIMENSIONS))), depths, 0.05 * depths
    )
    return joined([more, node.landmarks])


def _shuffled(s: LieInputs, maps: int, least: int, most: int) -> LyingMessages:
    """Maps of so many true views each, with wrong ways between them."""
    logs = {}
    for k in range(maps):
        which = replace(s, map=MapId(s.map.agent, s.map.epoch + k))
        size = least + k % (most - least + 1)
        some = [s.own[0][n] for n in sorted(s.rng.choice(len(s.own[0]), size, replace=False))]
        poses = [Pose2.from_vector(s.rng.uniform(-4.0, 4.0, 3)) for _ in some]
        logs[which.map] = messages(which.map, bodies(chain(which, some, poses)))
    return LyingMessages(logs)


def _torn(s: LieInputs, nodes: Sequence[Node]) -> Map:
    """Copies of two maps' nodes in turns, each of the second's shifted against where it is."""
    poses = [
        node.map_from_robot.mean if k % 2 == 0 else Pose2(OFF_M, -OFF_M, 1.0) @ node.map_from_robot.mean
        for k, node in enumerate(nodes)
    ]
    return chain(s, nodes, poses)


def _captured(s: LieInputs, nodes: Sequence[Node]) -> Map:
    """The own drive, and others' nodes behind its end, apart from each other by as much as theirs."""
    own, _ = s.own
    begin = own[-1].map_from_robot.mean @ Pose2(4 * OFF_M, 0.0, 0.0)
    poses = [node.map_from_robot.mean for node in own]
    poses += [begin @ nodes[0].map_from_robot.mean.inverse() @ node.map_from_robot.mean for node in nodes]
    return chain(s, [*own, *nodes], poses)


WAYS: dict[str, Callable[[LieInputs], LyingMessages]] = {
    "node at 1e9 m": far_node,
    "edges of 1e5 m": long_steps,
    "covariance of zero": covariance_of_zero,
    "covariance of 1e12": covariance_of_1e12,
    "greatest covariance": greatest_covariance,
    "contradicting clocks": contradicting_clocks,
    "100 000 landmarks": many_landmarks,
    "edges to nowhere": edges_to_nowhere,
    "sequence 2^53": greatest_sequence,
    "many epochs": many_epochs,
    "shuffled maps": shuffled_maps,
    "copies that tear": copied_to_tear,
    "altered copies that tear": altered_to_tear,
    "copied places": copied_places,
    "altered copied places": altered_places,
    "half copied landmarks": mixed_landmarks,
    "depths of 1.3": wrong_depths,
    "lenses in turns": other_lenses,
}
UNDECIDABLE: dict[str, Callable[[LieInputs], LyingMessages]] = {
    "another's times": same_times,
    "places seen from aside": places_from_aside,
}
"""Maps that are right in themselves and could be of a second building that looks the same: nothing that a
server knows tells which of the two robots lies. Answers may become ambiguous."""
OPEN: dict[str, Callable[[LieInputs], LyingMessages]] = {
    "a way of 1.05": scaled_way,
}
"""Maps that contradict others a little. The merge undoes what is off; the status of robots does not name them
(see mapweave.merge.pose_graph.map_scales)."""
EVERY: Mapping[str, Callable[[LieInputs], LyingMessages]] = {**WAYS, **UNDECIDABLE, **OPEN}
