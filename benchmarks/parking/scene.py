"""The scene of the parking benchmark: a robot maps a goal in the arena by itself, and is put down behind it.

The simulator's truth draws the scene and scores it; the robot never sees it.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.servo.planner import shortest_length
from benchmarks.servo.world import CAMERA as PLANNER_CAMERA
from benchmarks.servo.world import Task
from mapweave.agent.exploration.behaviours import Phase
from mapweave.agent.mission import Explore, Question, ServerAnswer, WhereAmI, WhichWay
from mapweave.agent.pipeline import Pipeline
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.routes import Router
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.placement import is_clear
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from synthetic.maps import merger_of

ROBOT = "r0"
NEAREST_VIEW, FARTHEST_VIEW = 1.5, 5.0
"""m from the goal to the wall that it looks at."""
NEAREST, FARTHEST, AHEAD = 0.3, 2.5, 0.1
"""m; starts are so far from the goal, and at most so far ahead of it."""
MOST_TURNED = math.pi / 4
"""rad; the start's heading is within this of the goal's."""
LEAST_SEEN = 6
"""Landmarks of the goal in the image at the start."""
ROOM = 0.1
"""m of free floor around the footprint at the goal, at the start and between them."""
PLANNED = 24
"""Landmarks of which the planner knows; with more it would find no fewer ways."""
MAPPING_TICKS = 3000
"""The robot has five minutes to map what is around the goal."""


class NoGoal(MapweaveError):
    """The arena has no place to park at."""


class ParkingScene:
    """One arena, one robot, one goal that the robot has mapped.

    Attributes:
        description: of the robot.
        own_map: what the robot has mapped.
        goal: the node at which it shall park.
        world_from_goal: where the robot really stood when it took the goal's image.
    """

    def __init__(self, seed: Sequence[int], one_view: bool) -> None:
        """Build the arena and let the robot map what it sees from a place in it.

        Args:
            seed: other seeds, other prints on the walls, another goal, other wheels, other noise.
            one_view: whether it maps the goal's view alone; else it looks all around the place, as it does
                when it explores.

        Raises:
            NoGoal: no place with a wall at the right distance, or the robot made no node of the view.
        """
        rng = np.random.default_rng([*seed, 0x9A4C])
        number = int(rng.integers(2**31))
        self._world, self._number = make_world("arena", number), number
        self.plan: BuildingPlan = self._world.plan
        with self.simulate(_goal(self.plan, rng)) as simulation:
            self.description = simulation.describe(ROBOT)
            self.own_map, self.goal = self._map(simulation, one_view)
            self.world_from_goal = simulation.truth_at(ROBOT, self.goal.stamp_ns)
        merger = merger_of({self.goal.id.map: self.own_map.contents()})
        merged = merger.merged()
        self._relocalizer = Relocalizer(merger.places, merger.node, merged)
        self._router = Router(merged)

    def simulate(self, world_from_robot: Pose2) -> Simulation:
        """The arena with the same robot, put down somewhere: no start depends on the starts before it."""
        return Simulation(self._world, [ROBOT], self._number, [world_from_robot])

    def answer(self, question: Question) -> ServerAnswer:
        """What the map server says to a robot's question."""
        match question:
            case WhereAmI():
                return ServerAnswer(question.number, self._relocalizer.answer(question.view))
            case WhichWay():
                way = self._router.route(
                    question.start, question.goal, question.blocked,
                    start_from_robot=question.start_from_robot,
                )  # fmt: skip
                return ServerAnswer(question.number, way)
        return ServerAnswer(question.number, None, "there are no other robots")

    def draw_start(self, rng: np.random.Generator) -> Pose2:
        """A start, `goal_from_robot`, as the benchmark draws them; whether there is a path is not asked."""
        radius = self.description.radius + ROOM
        here = (self.world_from_goal.x, self.world_from_goal.y)
        for _ in range(10_000):
            distance, direction = rng.uniform(NEAREST, FARTHEST), rng.uniform(-math.pi, math.pi)
            turn = float(rng.uniform(-MOST_TURNED, MOST_TURNED))
            start = Pose2(distance * math.cos(direction), distance * math.sin(direction), turn)
            there = self.world_from_goal @ start
            if start.x > AHEAD or self.seen(start) < LEAST_SEEN:
                continue
            if is_clear(self.plan, [here, (there.x, there.y)], radius):
                return start
        raise NoGoal("no start behind the goal sees six of its landmarks")

    def seen(self, goal_from_robot: Pose2) -> int:
        """How many of the goal's landmarks are in the image at a pose, as far as geometry tells."""
        return int(self.in_view(goal_from_robot).sum())

    def in_view(self, goal_from_robot: Pose2) -> NDArray[np.bool_]:
        """(N,) which of the goal's landmarks are in the image at a pose."""
        camera = self.goal.camera
        pixels = camera.project(goal_from_robot.inverse().apply(self.goal.points_in_robot))
        return camera.contains(pixels)

    def shortest(self, start: Pose2) -> float | None:
        """Length of the shortest path that keeps four landmarks in view, m; None if there is none."""
        points = self.goal.points_in_robot
        order = np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable")
        few = points[order[np.linspace(0, len(order) - 1, min(PLANNED, len(order))).round().astype(int)]]
        few[:, 2] += PLANNER_CAMERA.mount_height - self.goal.camera.mount_height
        return shortest_length(Task(start, few))

    def _map(self, simulation: Simulation, one_view: bool) -> tuple[HybridMap, Node]:
        """Explore until the view from the start is a node, or all the views from there are."""
        pipeline = Pipeline(MapId(ROBOT, 1), self.description)
        pipeline.set_mission(Explore())
        observation, made, answers = simulation.observe(ROBOT), list[Node](), tuple[ServerAnswer, ...]()
        for _ in range(MAPPING_TICKS):
            step = pipeline.step(observation, answers)
            answers = tuple(
                ServerAnswer(q.number, None, "there is no map server yet") for q in step.questions
            )
            made += [change.node for change in step.changes if isinstance(change, NodePut)]
            leaves = step.status.finished or step.status.doing == Phase.TRAVELLING
            if made and (one_view or leaves):
                return pipeline.map, made[0]
            observation = simulation.step({ROBOT: step.command})[ROBOT]
        raise NoGoal(f"{self._world.name}: the robot made no node of the view: {step.status.detail}")


def _goal(plan: BuildingPlan, rng: np.random.Generator) -> Pose2:
    """A free place that looks at a wall 1.5 to 5 m away, with room behind it to start from."""
    ways = np.arange(0.0, FARTHEST_VIEW + 0.5, 0.05)
    for _ in range(1000):
        pose = plan.random_free_pose(rng, 0.5)
        line = pose.apply(np.column_stack([ways, np.zeros_like(ways)]))
        free = plan.clearances(line) > 0.0
        view = float(ways[int(free.argmin())]) if not free.all() else math.inf
        behind = pose.apply(np.array([-1.2, 0.0]))
        if NEAREST_VIEW <= view <= FARTHEST_VIEW and plan.is_free(float(behind[0]), float(behind[1]), 0.3):
            return pose
    raise NoGoal("the arena has no place to park at")
