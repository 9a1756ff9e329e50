"""A map server that lies: a test double behind the robot's own bus. It can also tell the truth."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapweave.agent.navigation.route_source import onboard_route
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    Certainty,
    RelocalizeAnswer,
    ReserveAnswer,
    ReserveRequest,
    RouteAnswer,
    RouteLeg,
    RouteRequest,
    View,
    Whereabouts,
)
from mapweave.registration.recognition import RecognitionSettings, recognise
from mapweave.wire.bus import Bus, Request
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, decode_view, encode
from mapweave.wire.senders import sent_by_any
from synthetic.world import room, take_map

EXACT = np.diag([1e-4, 1e-4, 1e-5])
NEAR = 4.0
"""An honest server compares a view with nodes this near to the truth, m: the simulator's, for speed alone."""

Words = RelocalizeAnswer | RouteAnswer | bytes | None
"""An answer, raw bytes, or none."""
Lie = Callable[["LyingServer", View | RouteRequest, RelocalizeAnswer | RouteAnswer], Words]


class LyingServer:
    """Answers one robot. Each question has its honest answer, and what the lie makes of it.

    Attributes:
        lie: what it does to its answers; None is the truth.
        map: honest.
        truth: `world_from_node`.
        goal: of the robot's mission.
        rng: of the lies.
        asked: how many questions were asked.
    """

    def __init__(
        self, bus: Bus, keys: Keys, hybrid_map: HybridMap, truth: dict[NodeId, Pose2],
        world_from_robot: Callable[[], Pose2], seed: int,
    ) -> None:  # fmt: skip
        """Serve.

        Args:
            bus: of the server.
            keys: of the fleet.
            hybrid_map: honest.
            truth: of its nodes.
            world_from_robot: where the robot is: which nodes are worth a comparison.
            seed: of the lies.
        """
        self.lie: Lie | None = None
        self.map, self.truth = hybrid_map, truth
        self.goal = min(truth)
        self.rng = np.random.default_rng([seed, 0x11E])
        self.asked = 0
        self._world_from_robot = world_from_robot
        self._serving = [
            bus.serve(sent_by_any(keys.relocalize("s0")), self._relocalize),
            bus.serve(sent_by_any(keys.route("s0")), self._route),
            bus.serve(sent_by_any(keys.reserve("s0")), self._reserve),
        ]

    @property
    def here(self) -> Pose2:
        """Where the robot truly is."""
        return self._world_from_robot()

    def _relocalize(self, request: Request) -> None:
        view = decode_view(request.payload)
        near = [node for node, pose in self.truth.items() if pose.distance(self.here) < NEAR]
        found = [
            (recognition.inliers, node, recognition.node_from_robot)
            for node in near
            if (recognition := recognise(self.map.nodes[node], view, RecognitionSettings(), self.rng))
            is not None
        ]
        answer = RelocalizeAnswer(Certainty.UNKNOWN, (), "nothing is recognised")
        if found:
            inliers, node, pose = max(found, key=lambda one: one[0])
            answer = self.at(node, pose, inliers)
        self._answer(request, view, answer)

    def _route(self, request: Request) -> None:
        asked = decode(request.payload, RouteRequest)
        self._answer(request, asked, onboard_route(self.map, asked.start, asked.goal, asked.blocked))

    def _reserve(self, request: Request) -> None:
        route = decode(request.payload, ReserveRequest).route
        request.reply(encode(ReserveAnswer(len(route), "", None, "")))

    def _answer(
        self, request: Request, asked: View | RouteRequest, honest: RelocalizeAnswer | RouteAnswer
    ) -> None:
        self.asked += 1
        said = honest if self.lie is None else self.lie(self, asked, honest)
        if said is None:
            request.refuse("no answer")
        else:
            request.reply(said if isinstance(said, bytes) else encode(said))

    def at(self, node: NodeId, pose: PoseGaussian, inliers: int = 60) -> RelocalizeAnswer:
        """The robot is there, for sure."""
        place = Whereabouts(node, pose, None, 0, inliers, 0.999)
        return RelocalizeAnswer(Certainty.FOUND, (place,), f"{inliers} landmarks agree")

    def far(self) -> NodeId:
        """A node of the map far from the robot."""
        away = sorted(self.truth, key=lambda node: -self.truth[node].distance(self.here))
        return away[int(self.rng.integers(min(10, len(away))))]


def leg(node: Node, x: float, y: float = 0.0, heading: float = 0.0) -> RouteLeg:
    """A leg of a false route."""
    return RouteLeg(node, PoseGaussian(Pose2(x, y, heading), EXACT), EdgeKind.MAPPED)


def renamed(node: Node, number: int) -> Node:
    """A node that no map has."""
    return replace(node, id=NodeId("s9", 1, number))


# The lies


def wrong_place(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """A far node, always the same until it asks for a route."""
    if isinstance(asked, View):
        return server.at(server.far(), PoseGaussian(Pose2(0.1, 0.0, 0.1), EXACT))
    return honest  # type: ignore[return-value]


def displaced(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """The right place, half a metre aside."""
    return _moved(honest, Pose2(0.35, 0.35, 0.0))


def turned(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """The right place, turned by 90 degrees."""
    return _moved(honest, Pose2(0.0, 0.0, math.pi / 2))


def _moved(honest: object, by: Pose2) -> Words:
    if not isinstance(honest, RelocalizeAnswer) or not honest.candidates:
        return honest  # type: ignore[return-value]
    place = honest.candidates[0]
    pose = PoseGaussian(place.node_from_robot.mean @ by, EXACT)
    return replace(honest, candidates=(replace(place, node_from_robot=pose),))


def other_floor(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """A place on another floor, with a way from there."""
    rng = np.random.default_rng(7)
    poses = [Pose2(0.6 + 0.8 * k, 1.5) for k in range(5)]
    nodes, _ = take_map(room(0, 0, 5, 3, 400, rng), MapId("s9", 1), poses, rng, sigma_xy=0.002)
    if isinstance(asked, View):
        answer = server.at(nodes[0].id, PoseGaussian(Pose2(), EXACT))
        return replace(answer, candidates=(replace(answer.candidates[0], component=1, floor="2"),))
    goal = replace(nodes[-1], id=asked.goal)
    return RouteAnswer((leg(nodes[0], 0.0), *(leg(one, 0.8) for one in (*nodes[1:-1], goal))), "a way")


def through_walls(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """The right place, and straight to the goal, whatever is in between; a new node each time."""
    if isinstance(asked, View) or asked.start not in server.truth:
        return honest  # type: ignore[return-value]
    way = server.truth[asked.start].inverse() @ server.truth[asked.goal]
    between = renamed(server.map.nodes[asked.goal], 2 * server.asked + 1)
    start, goal = server.map.nodes[asked.start], server.map.nodes[asked.goal]
    half = leg(between, way.x / 2, way.y / 2)
    return RouteAnswer((leg(start, 0.0), half, leg(goal, way.x / 2, way.y / 2)), "straight on")


def absurd_legs(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """Legs of 90 m and of 900 km in turn."""
    if isinstance(asked, View) or not isinstance(honest, RouteAnswer):
        return honest  # type: ignore[return-value]
    size = (90.0, 9e5)[server.asked % 2]
    return (
        RouteAnswer((honest.legs[0], *(leg(one.node, size, -size / 2) for one in honest.legs[1:])), "a way")
        if honest.legs
        else honest
    )


def cyclic(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """There and back and there again, over nodes that are all real."""
    if isinstance(asked, View) or not isinstance(honest, RouteAnswer) or len(honest.legs) < 2:
        return honest  # type: ignore[return-value]
    there, back = list(honest.legs), []
    for before, now in zip(there[-2::-1], there[:0:-1], strict=True):
        back.append(RouteLeg(before.node, now.previous_from_node.inverse(), now.kind))
    return RouteAnswer((*there, *back, *there[1:]), "a way")


def endless(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """The goal is always some way ahead, beyond nodes that are in no map."""
    if isinstance(asked, View) or asked.start not in server.map.nodes:
        return honest  # type: ignore[return-value]
    goal = server.map.nodes[asked.goal]
    new = [renamed(goal, 20 * server.asked + 2 * k + 1) for k in range(6)]
    turn = asked.start_from_robot.heading
    ahead = asked.start_from_robot @ Pose2(1.0)
    first = leg(new[0], ahead.x, ahead.y, turn)
    start = server.map.nodes[asked.start]
    return RouteAnswer((leg(start, 0.0), first, *(leg(one, 1.0) for one in (*new[1:], goal))), "a way")


def garbage(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """Noise, a message with no numbers in it, a cut one, and one that is huge."""
    good = encode(honest)
    choice = server.asked % 4
    if choice == 0:
        return server.rng.bytes(int(server.rng.integers(0, 4000)))
    if choice == 1:
        # Every double of the message is no number.
        return good.replace(b"\xcb", b"\xcb\x7f\xf8\x00\x00\x00\x00\x00\x00"[:9])
    return good[: len(good) // 2] if choice == 2 else good * 200


def silent(server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
    """Nothing."""
    return None


class Late:
    """Each answer is the one to a question of long before, of its kind."""

    def __init__(self, by: int = 3) -> None:
        self._kept: dict[type, list[object]] = {}
        self._by = by

    def __call__(self, server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
        kept = self._kept.setdefault(type(asked), [])
        kept.append(honest)
        return kept[-self._by] if len(kept) >= self._by else None  # type: ignore[return-value]


class Contradictory:
    """The truth and three other places in turn."""

    def __call__(self, server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
        lies = (wrong_place, displaced, other_floor)
        choice = server.asked % 4
        return honest if choice == 3 else lies[choice](server, asked, honest)  # type: ignore[return-value]


class Copied:
    """The view that was asked about is handed back as a node, where a way begins that leads nowhere."""

    def __init__(self) -> None:
        self._node: Node | None = None

    def __call__(self, server: LyingServer, asked: View | RouteRequest, honest: object) -> Words:
        goal = server.map.nodes[server.goal]
        if isinstance(asked, View):
            count = min(len(asked), 120)
            landmarks = replace(
                goal.landmarks, pixels=asked.pixels[:count], codes=asked.codes[:count],
                depths=np.full(count, 2.0, np.float32), depth_sigmas=np.full(count, 0.1, np.float32),
            )  # fmt: skip
            self._node = replace(goal, id=NodeId("s9", 1, 20 * server.asked + 1), landmarks=landmarks)
            return server.at(self._node.id, PoseGaussian(Pose2(), EXACT))
        if self._node is None:
            return honest  # type: ignore[return-value]
        new = [renamed(goal, self._node.id.number + 2 * k) for k in range(1, 6)]
        return RouteAnswer((leg(self._node, 0.0), *(leg(one, 1.0) for one in (*new, goal))), "a way")


LIES: dict[str, Callable[[], Lie]] = {
    "wrong place": lambda: wrong_place,
    "right place, 0.5 m off": lambda: displaced,
    "right place, 90 degrees off": lambda: turned,
    "another floor": lambda: other_floor,
    "route through walls": lambda: through_walls,
    "absurd legs": lambda: absurd_legs,
    "cyclic routes": lambda: cyclic,
    "routes that never end": lambda: endless,
    "garbage": lambda: garbage,
    "silence": lambda: silent,
    "late answers": Late,
    "contradictory answers": Contradictory,
    "the view itself as a node": Copied,
}
"""By name."""
