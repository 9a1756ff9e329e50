"""Ways to lie, and one honest fault, each of which one rule alone contains.

They show what a rule adds where the ways of `mapweave.scenarios.liar.lies` are contained by several.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.scenarios.liar.lies import (
    SURE,
    LieInputs,
    Logs,
    LyingMessages,
    bodies,
    chain,
    messages,
    seen_from_aside,
)

CERTAIN = 1e-6 * np.eye(3)
"""Covariance of a step that is said to be known to a millimetre, m^2 and rad^2."""
TOO_LONG = 1.1
FALSE_EDGES, FALSE_MOST = 120, (5.0, 5.0, np.pi)
"""How many edges, and the most that they say, m, m and rad."""
ANYWHERE = (4.0, 4.0, np.pi)
"""Within which nodes are said to be, m, m and rad."""
SMALL = 3
"""Nodes of a map that is too small to be tested."""


def steps_too_long(s: LieInputs) -> LyingMessages:
    """True views, and steps a tenth too long, of which the robot is certain."""
    nodes, edges = s.own
    steps = [edge.a_from_b.mean for edge in edges]
    wrong = [Pose2(TOO_LONG * step.x, TOO_LONG * step.y, step.heading) for step in steps]
    some = [
        replace(edge, a_from_b=PoseGaussian(pose, CERTAIN)) for edge, pose in zip(edges, wrong, strict=True)
    ]
    return LyingMessages({s.map: messages(s.map, bodies((nodes, some)))})


def one_shuffled(s: LieInputs) -> LyingMessages:
    """One map of all its views, in an arrangement of its own."""
    return LyingMessages({s.map: _anywhere(s, s.map, s.own[0])})


def a_dozen(s: LieInputs) -> LyingMessages:
    """A dozen maps of five true views each, with wrong ways between them."""
    return LyingMessages(_some_maps(s, 12, 5))


def left_behind(s: LieInputs) -> LyingMessages:
    """Seven maps of three nodes with wrong ways between them, left for a true map."""
    last = replace(s, map=MapId(s.map.agent, s.map.epoch + 7))
    nodes = s.own[0]
    true = chain(last, nodes, [node.map_from_robot.mean for node in nodes])
    return LyingMessages({**_some_maps(s, 7, SMALL), last.map: messages(last.map, bodies(true))})


def false_edges(s: LieInputs) -> LyingMessages:
    """True views and a true way, and many certain and false edges between the robot's own nodes."""
    nodes, edges = s.own
    kinds = (EdgeKind.LOOP, EdgeKind.DRIVEN, EdgeKind.MAPPED, EdgeKind.TURNED)
    more = []
    for k in range(FALSE_EDGES):
        a, b = (nodes[n].id for n in s.rng.choice(len(nodes), 2, replace=False))
        more.append(_false_edge(s, k, a, b, kinds[k % len(kinds)], edges[0].shared[:0]))
    return LyingMessages({s.map: messages(s.map, bodies((nodes, [*edges, *more])))})


def all_twice(s: LieInputs) -> LyingMessages:
    """True views and a true way, and false loops by which each landmark of the robot occurs twice."""
    nodes, edges = s.own
    more = []
    for k, node in enumerate(nodes):
        other = nodes[(k + 7) % len(nodes)]
        every = np.arange(min(len(node.landmarks), len(other.landmarks)))
        shared = np.stack([every, every], axis=1).astype(edges[0].shared.dtype)
        more.append(_false_edge(s, k, node.id, other.id, EdgeKind.LOOP, shared))
    return LyingMessages({s.map: messages(s.map, bodies((nodes, [*edges, *more])))})


def clock_backwards(s: LieInputs) -> LyingMessages:
    """No lie: a true map of another robot's places, by a clock that ran backwards through its drive."""
    theirs = next(iter(s.others.values()))[0][::-1]
    seen = [seen_from_aside(node, s.rng) for node in theirs]
    nodes, edges = chain(s, seen, [node.map_from_robot.mean for node in seen])
    at = [replace(node, stamp_ns=other.stamp_ns) for node, other in zip(nodes, theirs, strict=True)]
    return LyingMessages({s.map: messages(s.map, bodies((at, edges)))})


def _some_maps(s: LieInputs, maps: int, size: int) -> Logs:
    """Maps of some of the robot's true views, with wrong ways between them."""
    logs: Logs = {}
    for k in range(maps):
        which = MapId(s.map.agent, s.map.epoch + k)
        some = [s.own[0][n] for n in sorted(s.rng.choice(len(s.own[0]), size, replace=False))]
        logs[which] = _anywhere(s, which, some)
    return logs


def _anywhere(s: LieInputs, map_id: MapId, nodes: Sequence[Node]) -> list[bytes]:
    """The log of a map that has true views anywhere."""
    most = np.array(ANYWHERE)
    poses = [Pose2.from_vector(s.rng.uniform(-most, most)) for _ in nodes]
    return messages(map_id, bodies(chain(replace(s, map=map_id), nodes, poses)))


def _false_edge(
    s: LieInputs, number: int, a: NodeId, b: NodeId, kind: EdgeKind, shared: NDArray[np.int64]
) -> Edge:
    most = np.array(FALSE_MOST)
    pose = PoseGaussian(Pose2.from_vector(s.rng.uniform(-most, most)), SURE)
    edge_id = s.id(10_001 + 2 * number)
    return Edge(edge_id, a, b, pose, kind, evidence={"inliers": 200.0}, shared=shared)


FEW, MANY = ("house", 1), ("room", 2)
"""Scenes with few shared places and with many, and how often robots stop there."""
MARGINS: Mapping[str, tuple[str, Callable[[LieInputs], LyingMessages], tuple[str, int]]] = {
    "steps a tenth too long": ("bent maps", steps_too_long, FEW),
    "one shuffled map": ("shuffled maps", one_shuffled, FEW),
    "a dozen small maps": ("maps that contradict themselves", a_dozen, FEW),
    "landmarks that occur twice": ("maps that contradict themselves", all_twice, FEW),
    "small maps left behind": ("fragments", left_behind, FEW),
    "false edges of its own": ("two sources of aliasing", false_edges, MANY),
    "a clock that runs backwards": ("clocks that run backwards", clock_backwards, FEW),
}
"""The rule that alone contains a way, by the way, and where; the last rule alone has the map joined."""
