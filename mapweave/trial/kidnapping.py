"""Whom to kidnap, where to put it down, where it shall go. Truth sets the stage; it does not help."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hybridmap.errors import MapweaveError
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import NodeId
from hybridmap.pose import Pose2
from sim.floorplan import FloorPlan

CLEARANCE = 0.32
"""m from walls and furniture where the robot is put down: it must be able to turn."""
NEAR = 0.6
"""m from some node that the room's own robot has made: the place is mapped."""
FAR = 2.0
"""m; a goal is worth a drive."""
LEAST_LANDMARKS = 30
"""A goal is a place with a view."""


class NothingToShow(MapweaveError):
    """The maps do not allow the kidnapping that was asked for."""


@dataclass(frozen=True)
class Kidnapping:
    """The plot.

    Attributes:
        robot: who is kidnapped.
        room: into which room, that only `host` has mapped.
        host: whose nodes are there.
        world_from_robot: where it is put down.
        goal: the node to which it shall go, of another robot than `host` where there are three.
    """

    robot: str
    room: str
    host: str
    world_from_robot: Pose2
    goal: NodeId


def plan_kidnapping(
    merged: HybridMap,
    components: Mapping[NodeId, int],
    truth: Mapping[NodeId, Pose2],
    plan: FloorPlan,
    robots: tuple[str, ...],
    occupied: list[Pose2],
    seed: int,
) -> Kidnapping:
    """Choose a robot, a room that only another robot has mapped, a place in it, and a third robot's node.

    Args:
        merged: all nodes.
        components: of the merged map.
        truth: where each node really is.
        plan: of the world.
        robots: all names.
        occupied: where the robots are now; nobody is put on top of another.
        seed: of the choice.

    Raises:
        NothingToShow: no choice is possible, in words.
    """
    rng = np.random.default_rng([seed, 0x105])
    rooms: dict[str, dict[str, list[NodeId]]] = {}
    for node, pose in truth.items():
        room = plan.room_at(pose.x, pose.y)
        if room is not None and room.startswith("room"):
            rooms.setdefault(room, {}).setdefault(node.agent, []).append(node)
    plots = []
    for robot in robots:
        for room, by_agent in sorted(rooms.items()):
            hosts = [agent for agent in by_agent if agent != robot]
            if robot in by_agent or len(hosts) != 1:
                continue
            goals = _goals(merged, components, truth, rooms, robot, room, hosts[0], by_agent[hosts[0]][0])
            if goals:
                plots.append((robot, room, hosts[0], goals))
    if not plots:
        raise NothingToShow(
            "no room is known to one robot alone, with a goal of a third that the merged map joins to it"
        )
    robot, room, host, goals = plots[int(rng.integers(len(plots)))]
    place = _place(rng, plan, [truth[n] for n in rooms[room][host]], occupied)
    if place is None:
        raise NothingToShow(f"no free place near the nodes in {room}")
    return Kidnapping(robot, room, host, place, goals[int(rng.integers(len(goals)))])


def choose_goal(
    merged: HybridMap,
    components: Mapping[NodeId, int],
    truth: Mapping[NodeId, Pose2],
    robot: str,
    world_from_robot: Pose2,
    foreign: bool,
    seed: int,
) -> NodeId:
    """Choose a node to which a robot can be sent from where it is.

    Args:
        merged: all nodes.
        components: of the merged map.
        truth: where each node really is.
        robot: who is sent.
        world_from_robot: where it is now.
        foreign: whether the node shall be another robot's.
        seed: of the choice.

    Raises:
        NothingToShow: no node is good for that.
    """
    nearest = min(sorted(truth), key=lambda n: truth[n].distance(world_from_robot), default=None)
    goals = [
        n
        for n in sorted(truth)
        if nearest is not None
        and components[n] == components[nearest]
        and (n.agent != robot) == foreign
        and len(merged.nodes[n].landmarks) >= LEAST_LANDMARKS
        and truth[n].distance(world_from_robot) >= FAR
    ]
    if not goals:
        whose = "another robot's" if foreign else "its own"
        raise NothingToShow(f"no node of {whose} map is {FAR:g} m away with a view, and joined to here")
    return goals[int(np.random.default_rng([seed, 0x60A1]).integers(len(goals)))]


def _goals(
    merged: HybridMap,
    components: Mapping[NodeId, int],
    truth: Mapping[NodeId, Pose2],
    rooms: Mapping[str, Mapping[str, list[NodeId]]],
    robot: str,
    room: str,
    host: str,
    start: NodeId,
) -> list[NodeId]:
    """Nodes of a third robot (of two: of either) in another room, or else anywhere outside this one."""
    third = [n for n in sorted(truth) if n.agent not in (robot, host)] or sorted(truth)
    here = {n for nodes in rooms[room].values() for n in nodes}
    good = [
        n
        for n in third
        if n not in here
        and len(merged.nodes[n].landmarks) >= LEAST_LANDMARKS
        and components[n] == components[start]
    ]
    in_a_room = {n for other, by in rooms.items() if other != room for nodes in by.values() for n in nodes}
    return [n for n in good if n in in_a_room] or good


def _place(
    rng: np.random.Generator, plan: FloorPlan, nodes: list[Pose2], occupied: list[Pose2]
) -> Pose2 | None:
    for _ in range(500):
        near = nodes[int(rng.integers(len(nodes)))]
        angle, distance = float(rng.uniform(0, math.tau)), NEAR * math.sqrt(float(rng.random()))
        place = Pose2(
            near.x + distance * math.cos(angle),
            near.y + distance * math.sin(angle),
            float(rng.uniform(-math.pi, math.pi)),
        )
        apart = min((place.distance(other) for other in occupied), default=math.inf)
        if plan.is_free(place.x, place.y, CLEARANCE) and apart > 0.6:
            return place
    return None
