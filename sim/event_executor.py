"""Executes events on a stage and its robots."""

import math
from collections.abc import Mapping

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim import faults, placement
from mapweave.sim.actors import FIGURES, Actor
from mapweave.sim.events import Fail, Kidnap, Light, MoveFurniture, SimEvent, Walk
from mapweave.sim.simulated_robot import SimulatedRobot, positions
from mapweave.sim.stage import Stage

SPACE = 0.02
"""A robot that is put down has this much room around it, m."""


class EventExecutor:
    """Executes every kind of event. Each event has its own random numbers, by its index."""

    def __init__(self, stage: Stage, robots: Mapping[str, SimulatedRobot], seed: int) -> None:
        """Start without events."""
        self._stage = stage
        self._robots = robots
        self._seed = seed
        self._count = 0

    def places(self) -> Array:
        """(R, 2) m, in world, of the robots."""
        return positions(list(self._robots.values()))

    def apply(self, event: SimEvent, tick: int) -> str:
        """Execute an event between two ticks; returns one line for people.

        Raises:
            InvalidValue: a robot, room or place that is not there, or where nothing fits.
        """
        self._count += 1
        rng = np.random.default_rng([self._seed, 0xE7E47, self._count])
        match event:
            case Kidnap():
                return self._kidnap(event, rng)
            case Light():
                self._stage.change_light(event.factor, tick, self._ticks(event.seconds, 0))
                return f"the light goes to {event.factor:g} within {event.seconds:g} s"
            case Walk():
                return self._walk(event, tick, rng)
            case MoveFurniture():
                return self._move_furniture(event)
            case Fail():
                self._robot(event.robot).faults.begin(event, tick, self._ticks(event.seconds, 1))
                return faults.describe(event)

    def _kidnap(self, event: Kidnap, rng: np.random.Generator) -> str:
        robot, plan = self._robot(event.robot), self._stage.world.plan
        radius = robot.description.radius + SPACE
        occupied = [(r.pose.x, r.pose.y) for name, r in self._robots.items() if name != event.robot]
        occupied += [(actor.pose.x, actor.pose.y) for actor in self._stage.actors]
        taken = np.array(occupied).reshape(-1, 2)
        if event.near:
            if event.near == event.robot:
                raise InvalidValue(f"kidnap: {event.robot} cannot be put near itself")
            pose = placement.beside(plan, rng, self._robot(event.near).pose, radius, taken)
        elif event.room:
            pose = placement.somewhere(plan, rng, radius, taken, event.room)
        else:
            wanted = Pose2(event.x or 0.0, event.y or 0.0, float(rng.uniform(-math.pi, math.pi)))
            pose = placement.put_down(plan, wanted, radius, taken)
        if event.heading is not None:
            pose = Pose2(pose.x, pose.y, event.heading)
        robot.put(pose)
        return f"{event.robot} is put down at ({pose.x:.2f}, {pose.y:.2f})"

    def _walk(self, event: Walk, tick: int, rng: np.random.Generator) -> str:
        plan, radius = self._stage.world.plan, FIGURES[event.what].radius
        if event.near:
            path = tuple(placement.past(plan, rng, self._robot(event.near).pose, radius))
        else:
            path = event.path
            placement.check_path(plan, path, radius)
        robots = list(self._robots.values())
        size = max(robot.description.radius for robot in robots)
        until = tick + self._ticks(event.seconds, 1)
        actor = Actor(event.what, path, event.speed, until, positions(robots), size)
        self._stage.enter(actor, (self._seed, 0xAC704, self._count))
        (x0, y0), (x1, y1) = path[0], path[-1]
        where = f"({x0:.2f}, {y0:.2f}) and ({x1:.2f}, {y1:.2f})"
        return f"a {event.what} goes to and fro between {where} for {event.seconds:g} s"

    def _move_furniture(self, event: MoveFurniture) -> str:
        before = self._stage.world
        keep_clear = [robot.pose for robot in self._robots.values()]
        for actor in self._stage.actors:
            keep_clear += [Pose2(x, y) for x, y in placement.sampled(actor.path)[::5].tolist()]
        after = before.rearranged(self._seed + self._count, event.share, keep_clear=keep_clear)
        self._stage.rearrange(after)
        pairs = zip(before.plan.furniture, after.plan.furniture, strict=True)
        moved = sum(old != new for old, new in pairs)
        return f"{moved} of {len(after.plan.furniture)} pieces of furniture have moved"

    def _ticks(self, seconds: float, least: int) -> int:
        tick = next(iter(self._robots.values())).description.tick
        return max(least, round(seconds / tick))

    def _robot(self, name: str) -> SimulatedRobot:
        if name not in self._robots:
            raise InvalidValue(f"no robot {name!r}; there are {', '.join(self._robots)}")
        return self._robots[name]
