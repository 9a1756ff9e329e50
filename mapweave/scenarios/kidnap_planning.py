"""Plans a kidnapping: which robot, where to put it down, where to send it. Uses the ground truth."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.floorplan import BuildingPlan, Rectangle

CLEARANCE = 0.32
"""m from walls and furniture where the robot is put down: it must be able to turn."""
NEAR = 0.6
"""m from some node that the room's own robot has made: the place is mapped."""
FAR = 2.0
"""m; a goal is worth a drive."""
HALF_WIDTH = 0.16
"""Half the width of a robot that is in the way, m."""
ROOM = 0.26
"""Half the width of what a robot drives through, m."""
STEPS = 12
"""Points on the line between two nodes that are tested for robots."""
NEARBY = 0.25
"""A robot may stop or park this near to drivable floor, m."""
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
    plan: BuildingPlan,
    robots: tuple[str, ...],
    standing: Mapping[str, Pose2],
    seed: int,
) -> Kidnapping:
    """Choose a robot, a room that only another robot has mapped, a place in it, and a third robot's node.

    The others do not move: a goal to which they leave no way is not used.

    Args:
        merged: all nodes.
        components: of the merged map.
        truth: where each node really is.
        plan: of the world.
        robots: all names.
        standing: poses of the robots now; a robot is not put on top of another.
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
    for number in rng.permutation(len(plots)):
        robot, room, host, goals = plots[int(number)]
        place = _place(rng, plan, [truth[n] for n in rooms[room][host]], list(standing.values()))
        if place is None:
            continue
        other_poses = [pose for name, pose in standing.items() if name != robot]
        way, mapped = _way(plan, other_poses, place), _open_ways(merged, truth, other_poses)
        start = min(rooms[room][host], key=lambda node: (truth[node].distance(place), node))
        reachable = nx.node_connected_component(mapped, start)
        reached = [goal for goal in goals if goal in reachable and way(truth[goal])]
        if reached:
            return Kidnapping(robot, room, host, place, reached[int(rng.integers(len(reached)))])
    raise NothingToShow("no free place near the nodes of such a room, from which the others leave a way")


def _way(plan: BuildingPlan, other_poses: Sequence[Pose2], start: Pose2) -> Callable[[Pose2], bool]:
    """Tests whether a robot can get from one place to another around standing robots."""
    footprints = tuple(Rectangle(o.x, o.y, 2 * HALF_WIDTH, 2 * HALF_WIDTH, o.heading) for o in other_poses)
    regions = BuildingPlan(plan.rooms, plan.walls, (*plan.furniture, *footprints)).free_regions(ROOM)

    def region(pose: Pose2) -> int | None:
        gaps = [float(np.hypot(*(points - [pose.x, pose.y]).T).min()) for points in regions]
        nearest = int(np.argmin(gaps)) if gaps else None
        return nearest if nearest is not None and gaps[nearest] < NEARBY else None

    start_region = region(start)
    return lambda goal: start_region is not None and region(goal) == start_region


def _open_ways(merged: HybridMap, truth: Mapping[NodeId, Pose2], other_poses: Sequence[Pose2]) -> nx.Graph:
    """The nodes, and those edges that pass no standing robot too closely."""
    graph: nx.Graph = nx.Graph()
    graph.add_nodes_from(truth)
    positions = np.array([[pose.x, pose.y] for pose in other_poses]).reshape(-1, 2)
    for edge in merged.edges.values():
        if edge.a not in truth or edge.b not in truth:
            continue
        start, end = (np.array([truth[node].x, truth[node].y]) for node in (edge.a, edge.b))
        way = np.linspace(start, end, STEPS)
        gaps = np.linalg.norm(way[:, None] - positions[None], axis=2)
        if gaps.min(initial=np.inf) > HALF_WIDTH + ROOM:
            graph.add_edge(edge.a, edge.b)
    return graph


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
        owner = "another robot's" if foreign else "its own"
        raise NothingToShow(f"no node of {owner} map is {FAR:g} m away with a view, and joined to here")
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
    in_room = {n for nodes in rooms[room].values() for n in nodes}
    good = [
        n
        for n in third
        if n not in in_room
        and len(merged.nodes[n].landmarks) >= LEAST_LANDMARKS
        and components[n] == components[start]
    ]
    in_a_room = {n for name, by in rooms.items() if name != room for nodes in by.values() for n in nodes}
    return [n for n in good if n in in_a_room] or good


def _place(
    rng: np.random.Generator, plan: BuildingPlan, nodes: list[Pose2], occupied: list[Pose2]
) -> Pose2 | None:
    for _ in range(500):
        node = nodes[int(rng.integers(len(nodes)))]
        angle, distance = float(rng.uniform(0, math.tau)), NEAR * math.sqrt(float(rng.random()))
        place = Pose2(
            node.x + distance * math.cos(angle),
            node.y + distance * math.sin(angle),
            float(rng.uniform(-math.pi, math.pi)),
        )
        apart = min((place.distance(pose) for pose in occupied), default=math.inf)
        if plan.is_free(place.x, place.y, CLEARANCE) and apart > 0.6:
            return place
    return None
