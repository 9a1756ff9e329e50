"""Fleets of which one robot has wrong geometry: a long or turning odometry, a slip, a carried robot."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, View
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.merging.merger import Merger
from synthetic.world import World, room, take_node, take_view

SIGMA_XY, SIGMA_HEADING = 0.015, 0.008
"""Noise that a robot reports for each step, and the true noise of a correct one, m and rad."""
RIGHT_M = 0.35
"""An answered position nearer to the truth than this is right."""
MARGIN = 0.6
"""m, robots keep away from walls."""


class OdometryFault(StrEnum):
    """What is wrong with a robot's odometry."""

    NONE = "none"
    LONG = "long"
    """Every distance is measured 30 % too long."""
    TURNS = "turns"
    """Every turn is measured 10 % too large."""
    SLIP = "slip"
    """Once it moves 2 m that it does not measure."""
    CARRIED = "carried"
    """Once it is carried to another place, and does not notice."""


@dataclass(frozen=True, eq=False)
class House:
    """Rooms whose walls hide each other.

    Attributes:
        rooms: landmarks of each.
        boxes: (x, y, width, depth) of each, m.
    """

    rooms: tuple[World, ...]
    boxes: tuple[tuple[float, float, float, float], ...]

    def seen_from(self, at: Pose2) -> World:
        """What can be seen from a place."""
        for world, (x, y, width, depth) in zip(self.rooms, self.boxes, strict=True):
            if x < at.x < x + width and y < at.y < y + depth:
                return world
        raise ValueError(f"{at} is in no room")

    def inside(self, number: int, rng: np.random.Generator) -> Pose2:
        """A random pose in a room."""
        x, y, width, depth = self.boxes[number]
        low = [x + MARGIN, y + MARGIN, -math.pi]
        return Pose2.from_vector(rng.uniform(low, [x + width - MARGIN, y + depth - MARGIN, math.pi]))


def draw_house(rng: np.random.Generator, *, twins: bool = False, count: int = 2) -> House:
    """Rooms in a row. With `twins` the last two look the same."""
    rooms, boxes, x = list[World](), list[tuple[float, float, float, float]](), 0.0
    for k in range(count):
        width, depth = rng.uniform(4.0, 6.0), rng.uniform(3.5, 5.0)
        if twins and k == count - 1:
            _, _, width, depth = boxes[-1]
            shift = Pose2(x - boxes[-1][0], 0.0, 0.0)
            rooms.append(rooms[-1].moved(shift))
        else:
            rooms.append(room(x, 0.0, width, depth, round(40 * (width + depth) * 2), rng))
        boxes.append((x, 0.0, width, depth))
        x += width + 0.2
    return House(tuple(rooms), tuple(boxes))


def draw_tour(
    house: House, visits: Sequence[int], stops: int, views: int, rng: np.random.Generator
) -> list[Pose2]:
    """Poses of a robot that drives from room to room and turns around at each stop."""
    tour: list[Pose2] = []
    for number in visits:
        for _ in range(stops):
            choice = [house.inside(number, rng) for _ in range(4)]
            # Robots go to what is near: long ways are rare.
            stop = min(choice, key=tour[-1].distance) if tour else choice[0]
            tour += [Pose2(stop.x, stop.y, stop.heading + k * math.tau / views) for k in range(views)]
    return tour


def draw_map(
    house: House, map_id: MapId, tour: Sequence[Pose2], fault: OdometryFault, rng: np.random.Generator
) -> tuple[list[Node], list[Edge], dict[NodeId, Pose2]]:
    """A robot's map of a tour, and where its nodes truly are."""
    nodes: list[Node] = []
    edges: list[Edge] = []
    truth: dict[NodeId, Pose2] = {}
    broken = (
        round(len(tour) * rng.uniform(0.4, 0.6))
        if fault in (OdometryFault.SLIP, OdometryFault.CARRIED)
        else -1
    )
    aside = rng.uniform(-math.pi, math.pi)
    place = PoseGaussian(Pose2(), np.zeros((3, 3)))
    for k, true in enumerate(tour):
        node_id = NodeId(*map_id, 2 * k + 1)
        if k:
            before = tour[k - 1]
            step = before.inverse() @ true
            if fault is OdometryFault.LONG:
                step = Pose2(1.3 * step.x, 1.3 * step.y, step.heading)
            elif fault is OdometryFault.TURNS:
                turn = math.remainder(step.heading, math.tau)
                step = Pose2(step.x, step.y, 1.1 * turn)
            elif k == broken and fault is OdometryFault.SLIP:
                step = Pose2(2.0 * math.cos(aside), 2.0 * math.sin(aside), 0.0) @ step
            elif k == broken:
                step = Pose2(0.5, 0.0, 0.3)
            noise = Pose2.from_vector(rng.normal(0.0, [SIGMA_XY, SIGMA_XY, SIGMA_HEADING]))
            measured = PoseGaussian.from_sigmas(step @ noise, SIGMA_XY, SIGMA_HEADING)
            place = place @ measured
            kind = EdgeKind.TURNED if before.distance(true) < 0.05 else EdgeKind.MAPPED
            edges.append(Edge(NodeId(*map_id, 2 * k), nodes[-1].id, node_id, measured, kind))
        nodes.append(take_node(house.seen_from(true), node_id, true, place, rng))
        truth[node_id] = true
    return nodes, edges, truth


@dataclass(frozen=True, eq=False)
class FaultyFleet:
    """Maps of one house, and the truth.

    Attributes:
        house: where.
        maps: nodes and edges of each robot.
        truth: `world_from_robot` of each node.
    """

    house: House
    maps: dict[MapId, tuple[list[Node], list[Edge]]]
    truth: dict[NodeId, Pose2]

    def changes(self, left_out: frozenset[MapId] = frozenset()) -> list[Change]:
        """The changes of all maps in turns, as from robots that map at the same time."""
        queues = []
        for map_id, (nodes, edges) in self.maps.items():
            if map_id not in left_out:
                content: list[ChangeBody] = [NodePut(nodes[0])]
                for node, edge in zip(nodes[1:], edges, strict=True):
                    content += [NodePut(node), EdgePut(edge)]
                queues.append([Change(map_id, n, 0, change) for n, change in enumerate(content, start=1)])
        out = []
        for k in range(max(map(len, queues))):
            out += [queue[k] for queue in queues if k < len(queue)]
        return out


ODD = MapId("r3", 1)
"""The robot with the fault."""


@dataclass(frozen=True)
class MappingPlan:
    """Which rooms each robot maps.

    Attributes:
        name: in the table.
        twins: whether the last two of the rooms look the same.
        sound: rooms that each sound robot visits, in order.
        odd: rooms that the robot with the fault visits.
        asked: rooms in which robots are lost.
        rooms: how many.
    """

    name: str
    twins: bool
    sound: tuple[tuple[int, ...], ...]
    odd: tuple[int, ...]
    asked: tuple[int, ...]
    rooms: int = 2


SCENES = {
    scene.name: scene
    for scene in (
        MappingPlan("room", False, ((0,), (0,), (0,)), (0,), (0,), rooms=1),
        MappingPlan("house", False, ((0, 1), (1, 0), (0, 1)), (0, 1), (0, 1)),
        # The correct robots know the first of the two similar rooms, the fourth one the second.
        MappingPlan("twins", True, ((0, 1), (1, 0), (0, 1)), (0, 2), (1, 2), rooms=3),
        MappingPlan("twins both", True, ((0, 1, 2), (2, 1, 0), (0, 2, 1)), (0, 2), (1, 2), rooms=3),
        MappingPlan("twins alone", True, ((1,), (1,), (1,)), (2,), (1, 2), rooms=3),
    )
}


def draw_fleet(
    seed: int, scene: MappingPlan, fault: OdometryFault, stops: int = 3, views: int = 5
) -> FaultyFleet:
    """Three sound robots, and one with a fault."""
    rng = np.random.default_rng([seed, 0x0DD])
    house = draw_house(rng, twins=scene.twins, count=scene.rooms)
    maps, truth = {}, dict[NodeId, Pose2]()
    for k, visits in enumerate((*scene.sound, scene.odd)):
        odd = k == len(scene.sound)
        own = np.random.default_rng([seed, k])
        count = round(stops * 2 / len(visits)) if not scene.twins else stops
        tour = draw_tour(house, visits, count, views, own)
        map_id = ODD if odd else MapId(f"r{k}", 1)
        nodes, edges, true = draw_map(house, map_id, tour, fault if odd else OdometryFault.NONE, own)
        maps[map_id] = nodes, edges
        truth |= true
    return FaultyFleet(house, maps, truth)


def merged_fleet(fleet: FaultyFleet, left_out: frozenset[MapId] = frozenset()) -> Merger:
    """All changes taken in, merged twice on the way."""
    merger = Merger()
    changes = fleet.changes(left_out)
    for k, change in enumerate(changes):
        merger.on_change(change)
        if k in (len(changes) // 3, 2 * len(changes) // 3):
            merger.merged()
    merger.merged()
    return merger


def lost_views(fleet: FaultyFleet, scene: MappingPlan, count: int, seed: int) -> list[tuple[View, Pose2]]:
    """Views of lost robots, near mapped places, and their true poses."""
    rng = np.random.default_rng([seed, 0x105])
    out = []
    box = {number: fleet.house.boxes[number] for number in scene.asked}
    nearby = [
        pose for pose in fleet.truth.values()
        if any(x < pose.x < x + w and y < pose.y < y + d for x, y, w, d in box.values())
    ]  # fmt: skip
    for _ in range(count):
        pose = nearby[rng.integers(len(nearby))]
        while True:
            at = pose @ Pose2.from_vector(rng.normal(0.0, [0.2, 0.2, 0.15]))
            try:
                world = fleet.house.seen_from(at)
                break
            except ValueError:
                continue
        out.append((take_view(world, at, rng)[0], at))
    return out


class AnswerOutcome(StrEnum):
    """What an answer is worth."""

    RIGHT = "right"
    WRONG = "wrong"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


def judged(answers: Answers, view: View, at: Pose2, truth: dict[NodeId, Pose2]) -> AnswerOutcome:
    """Compare an answer with the truth."""
    answer = answers.relocalizer.answer(view)
    if answer.certainty is not Certainty.FOUND:
        return AnswerOutcome.AMBIGUOUS if answer.certainty is Certainty.AMBIGUOUS else AnswerOutcome.UNKNOWN
    best = answer.candidates[0]
    off = (truth[best.node] @ best.node_from_robot.mean).distance(at)
    return AnswerOutcome.RIGHT if off < RIGHT_M else AnswerOutcome.WRONG


def outcome(
    fleet: FaultyFleet, views: Sequence[tuple[View, Pose2]], left_out: frozenset[MapId] = frozenset()
) -> dict[str, Any]:
    """Merge a fleet and ask: answers of each sort, parts of the sound maps, and maps that are found wrong."""
    merger = merged_fleet(fleet, left_out)
    merged = merger.merged()
    answers = Answers.of(merger, merged, merger.node)
    verdicts = Counter(judged(answers, view, at, fleet.truth) for view, at in views)
    parts = sum(any(node.map != ODD for node in part) for part in merged.components)
    wrong = [verdict.reason for verdict in merged.wrong.values()]
    return {str(verdict): verdicts[verdict] for verdict in AnswerOutcome} | {"parts": parts, "found": wrong}
