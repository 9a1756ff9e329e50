"""Robots in a world, in lock-step: one call is one tick, and the same calls give the same result."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim import rangers
from mapweave.sim.body import body_panels
from mapweave.sim.event_executor import EventExecutor
from mapweave.sim.events import SimEvent
from mapweave.sim.placement import starting_places
from mapweave.sim.robots import RobotSetup, robot_setups
from mapweave.sim.simulated_robot import SimulatedRobot
from mapweave.sim.snapshot import Snapshot
from mapweave.sim.stage import SUBSTEPS, Stage
from mapweave.sim.world import World

TICK = 0.1
"""Simulated time of a tick, s."""
TICK_NS = 100_000_000
"""Simulated time of a tick, ns."""


class Simulation:
    """Physics, cameras and rangers of several robots, and the truth about them.

    All of it happens in the thread that calls, but `observe` may be called for different robots in different
    threads at the same time, as long as nothing else is.

    Attributes:
        robots: their names.
        tick: how often time has advanced.
    """

    def __init__(
        self,
        world: World,
        robots: Sequence[str | RobotSetup],
        seed: int,
        poses: Sequence[Pose2] | None = None,
    ) -> None:
        """Build the world and put the robots into it.

        Args:
            world: solid blocks and textured panels.
            robots: 1 to 16; a name alone means the standard robot.
            seed: of start places, wheels, slip, noise, and of what happens.
            poses: start places, `world_from_robot`, instead of those of the robots' setups; by default
                those of the setups, the others spread over the rooms.

        Raises:
            InvalidValue: too many robots, names that are not unique, or places where no robot can stand.
        """
        setups = robot_setups(robots)
        self.robots = tuple(setup.name for setup in setups)
        self.tick = 0
        places = tuple(poses) if poses is not None else starting_places(world, setups, seed)
        self._stage = Stage(world, [body_panels(k) for k in range(len(setups))], TICK)
        self._robots = {
            setup.name: SimulatedRobot(setup, self._stage, place, (seed, k))
            for k, (setup, place) in enumerate(zip(setups, places, strict=True))
        }
        self._events = EventExecutor(self._stage, self._robots, seed)
        self._clock = re.sub(r"[^a-z0-9-]", "-", f"sim-{world.name}-{seed}".lower())[:32]
        self._wall = {"physics": 0.0, "rangers": 0.0}
        self._log: dict[str, list[Array]] = {name: [] for name in self.robots}
        self._sense()
        self._remember()

    def __enter__(self) -> Simulation:
        """Return self: it is built already."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the physics."""
        self.close()

    def close(self) -> None:
        """Release the physics. Idempotent."""
        self._stage.close()

    @property
    def world(self) -> World:
        """Where the robots are, as it is furnished now."""
        return self._stage.world

    @property
    def stamp_ns(self) -> int:
        """Simulated time."""
        return self.tick * TICK_NS

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time by part: physics, rangers, render; of several threads that of each."""
        return {**self._wall, "render": sum(robot.render_seconds for robot in self._robots.values())}

    def describe(self, name: str) -> RobotDescription:
        """The description that the robot's agent gets. All robots of a simulation have one clock."""
        return replace(self._robot(name).description, clock=self._clock)

    def step(self, commands: Mapping[str, Command]) -> dict[str, Observation]:
        """Advance one tick and observe with every robot, in the order of their names."""
        self.advance(commands)
        return {name: self.observe(name) for name in self.robots}

    def advance(self, commands: Mapping[str, Command]) -> None:
        """Advance exactly one tick; a robot without a command stands still.

        Raises:
            InvalidValue: a command for a robot that is not there.
        """
        for name in commands:
            self._robot(name)
        start = time.perf_counter()
        bodies = [robot.body for robot in self._robots.values()]
        self._stage.pass_time(self.tick + 1, TICK, self._events.places())
        for name, robot in self._robots.items():
            robot.body.drive(commands.get(name, Command()))
        for _ in range(SUBSTEPS):
            for body in bodies:
                body.substep(TICK / SUBSTEPS)
            self._stage.physics.stepSimulation()
        for body in bodies:
            body.settle()
        self.tick += 1
        self._wall["physics"] += time.perf_counter() - start
        self._sense()
        self._remember()

    def observe(self, name: str) -> Observation:
        """What a robot senses now. Its odometry counts from its last observation."""
        return self._robot(name).observe(self._stage, self.tick)

    def apply(self, event: SimEvent) -> str:
        """Execute an event between two ticks; returns one line for people.

        Raises:
            InvalidValue: a robot or a place that is not there.
        """
        line = self._events.apply(event, self.tick)
        self._sense()
        return line

    def kidnap(self, name: str, pose: Pose2) -> None:
        """Pick a robot up and put it down elsewhere (`world_from_robot`); its encoders do not notice."""
        self._robot(name).put(pose)
        self._sense()

    def snapshot(self) -> Snapshot:
        """The view from above, and the robots' last images."""
        return Snapshot(
            tick=self.tick,
            stamp_ns=self.stamp_ns,
            robots={name: robot.pose for name, robot in self._robots.items()},
            actors=tuple(actor.rectangle for actor in self._stage.actors),
            furniture=self.world.plan.furniture,
            images={name: robot.image for name, robot in self._robots.items()},
        )

    def truth(self, name: str) -> Pose2:
        """A robot's true pose, `world_from_robot`."""
        return self._robot(name).pose

    def truth_at(self, name: str, stamp_ns: int) -> Pose2:
        """A robot's true pose at a tick.

        Raises:
            InvalidValue: a time that was not simulated.
        """
        self._robot(name)
        tick = stamp_ns // TICK_NS
        if not 0 <= tick <= self.tick:
            raise InvalidValue(f"{stamp_ns} ns is not between 0 and {self.stamp_ns} ns")
        return Pose2.from_vector(self._log[name][tick])

    def trajectory(self, name: str) -> tuple[NDArray[np.int64], Array]:
        """(N,) ns and (N, 3) [x m, y m, heading rad] in world, one a tick from the start."""
        self._robot(name)
        return np.arange(self.tick + 1, dtype=np.int64) * TICK_NS, np.array(self._log[name])

    def collisions(self, name: str) -> int:
        """Number of a robot's collisions."""
        return self._robot(name).body.collisions

    def _robot(self, name: str) -> SimulatedRobot:
        if name not in self._robots:
            raise InvalidValue(f"no robot {name!r}; there are {', '.join(self.robots)}")
        return self._robots[name]

    def _sense(self) -> None:
        """Read poses and rangers of all robots: PyBullet serves one thread at a time."""
        start = time.perf_counter()
        robots = tuple(self._robots.values())
        self._stage.place_robots([robot.measure(self.tick) for robot in robots])
        rangers.cast(self._stage.physics, [r.rangers for r in robots], [r.pose for r in robots])
        self._wall["rangers"] += time.perf_counter() - start

    def _remember(self) -> None:
        for name, robot in self._robots.items():
            self._log[name].append(robot.pose.vector)
