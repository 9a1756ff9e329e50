"""Where robots are put down, and where they shall go. Truth sets the stage; it does not help."""

import math
from dataclasses import dataclass

import networkx as nx
import numpy as np

from benchmarks.navigate.floor import FreeFloor
from benchmarks.navigate.office import Mapped
from mapweave.evaluation.map_score import crossed
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.scenarios.kidnap_planning import CLEARANCE, LEAST_LANDMARKS, NEAR
from mapweave.sim.floorplan import BuildingPlan

LEAST_EDGES = 4
"""Between the node next to the start and the goal."""
UNMAPPED, UNMAPPED_TURN = 0.15, math.radians(15.0)
"""A pose this far from that of every node, in m or rad, is one that no image was taken from."""
TRIES = 2000


@dataclass(frozen=True)
class Plot:
    """One drive before it is driven.

    Attributes:
        world_from_robot: where the robot is put down.
        goal: the node to go to.
        world_from_goal: where its image was truly taken.
        edges: of the map between the node next to the start and the goal, at least.
        shortest: length of the shortest way for a robot that knows the floor, m.
    """

    world_from_robot: Pose2
    goal: NodeId
    world_from_goal: Pose2
    edges: int
    shortest: float


def draw_plot(mapped: Mapped, plan: BuildingPlan, floor: FreeFloor, rng: np.random.Generator) -> Plot:
    """Draw a start at an unmapped pose near some node, and a goal with a view at least four edges away.

    Args:
        mapped: nodes, edges and where they truly are.
        plan: of the building.
        floor: free for the robot.
        rng: where chance comes from.

    Raises:
        InvalidValue: the map is too small for such a drive.
    """
    nodes = sorted(mapped.truth)
    for _ in range(TRIES if nodes else 0):
        near = mapped.truth[nodes[int(rng.integers(len(nodes)))]]
        angle, away = float(rng.uniform(-math.pi, math.pi)), NEAR * math.sqrt(float(rng.random()))
        start = Pose2(
            near.x + away * math.cos(angle),
            near.y + away * math.sin(angle),
            float(rng.uniform(-math.pi, math.pi)),
        )
        line = np.array([[[near.x, near.y]], [[start.x, start.y]]])
        if not plan.is_free(start.x, start.y, CLEARANCE) or crossed(line[0], line[1], plan.walls)[0]:
            continue
        if not _unmapped(mapped, start):
            continue
        far = _goals(mapped, start)
        if not far:
            continue
        ways = floor.ways_from(start)
        goals = [one for one in far if math.isfinite(ways.to(mapped.truth[one[0]]))]
        if goals:
            goal, edges = goals[int(rng.integers(len(goals)))]
            return Plot(start, goal, mapped.truth[goal], edges, ways.to(mapped.truth[goal]))
    raise InvalidValue(
        f"the map of {len(nodes)} nodes has no start with a goal {LEAST_EDGES} edges away: explore for longer"
    )


def _unmapped(mapped: Mapped, start: Pose2) -> bool:
    return all(
        start.distance(taken) >= UNMAPPED or abs(wrap_angle(start.heading - taken.heading)) >= UNMAPPED_TURN
        for taken in mapped.truth.values()
    )


def _goals(mapped: Mapped, start: Pose2) -> list[tuple[NodeId, int]]:
    """Goals with a view, with the edges that lead to them from the node next to the start."""
    graph = mapped.nodes.graph()
    beside = min(mapped.truth, key=lambda node: (mapped.truth[node].distance(start), node))
    hops = nx.single_source_shortest_path_length(graph, beside)
    return [
        (node, edges)
        for node, edges in sorted(hops.items())
        if edges >= LEAST_EDGES
        and node in mapped.truth
        and len(mapped.nodes.nodes[node].landmarks) >= LEAST_LANDMARKS
    ]
