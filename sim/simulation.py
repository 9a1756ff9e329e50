"""Robots in a world, in lock-step: one call is one tick, and the same calls give the same result."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from agent.observation import Command, Observation, RobotDescription
from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.node import check_name
from hybridmap.pose import Array, Pose2
from sim.body import Body, body_panels
from sim.physics import Physics
from sim.renderer import Renderer
from sim.world import PanelSet, World

TICK_NS = 100_000_000
"""Simulated time of a tick, ns."""
SUBSTEPS = 12
"""Steps of the physics in a tick: 120 Hz."""
SOLVER_ITERATIONS = 40
"""Of PyBullet's contact solver. Together with SUBSTEPS: over a drive of 9 m and three turns, wheels without
slip then lose 2 mm to the solver, as they do with twice the steps and PyBullet's 50 iterations."""
RANGER_HEIGHT = 0.12
"""Height of the proximity sensors, m."""
RANGER_GAP = 1e-3
"""Rays start this far outside of the robot's edge, so that they do not meet the robot itself, m."""
READ_OUT_NOISE = 2.0
"""Standard deviation of a pixel, grey levels."""
RANGE_NOISE = 0.01
"""Standard deviation of a range, as a share of it."""

WEBCAM = Camera(width=320, height=240, fx=277.0, fy=277.0, cx=159.5, cy=119.5, mount_height=0.3)
"""60 degrees across, on a mast above the axle."""


def standard_robot() -> RobotDescription:
    """The robot that the simulator builds: what its agent is told."""
    return RobotDescription(
        camera=WEBCAM,
        ranger_bearings=tuple(float(a) for a in np.arange(16) * math.tau / 16),
        ranger_reach=3.0,
    )


class Simulation:
    """Physics, cameras and rangers of several robots, and the truth about them.

    Attributes:
        world: where they are.
        robots: their names.
        tick: how often time has advanced.
        seconds: wall time by part: physics, render, rangers.
    """

    def __init__(
        self, world: World, robots: Sequence[str], seed: int, poses: Sequence[Pose2] | None = None
    ) -> None:
        """Build the world and put the robots into it.

        Args:
            world: solid blocks and textured panels.
            robots: names.
            seed: of start places, wheels, slip and noise.
            poses: start places, `world_from_robot`; by default spread over the rooms.

        Raises:
            InvalidValue: names that are not unique or cannot be names.
        """
        self.world = world
        self.robots = tuple(check_name(name) for name in robots)
        if len(set(self.robots)) != len(self.robots):
            raise InvalidValue("two robots have the same name")
        self.tick = 0
        self.seconds = {"physics": 0.0, "render": 0.0, "rangers": 0.0}
        self._description = description = standard_robot()
        self._physics = Physics()
        self._physics.setGravity(0, 0, -9.81)
        self._physics.setTimeStep(description.tick / SUBSTEPS)
        self._physics.setPhysicsEngineParameter(
            deterministicOverlappingPairs=1, numSolverIterations=SOLVER_ITERATIONS
        )
        self._floor = self._build_world()
        places = poses if poses is not None else world.start_poses(len(self.robots), seed)
        self._bodies = {
            name: Body(self._physics, self._floor, pose, description, (seed, 0xB0D1, k))
            for k, (name, pose) in enumerate(zip(self.robots, places, strict=True))
        }
        self._noise = {name: np.random.default_rng([seed, 0x701E, k]) for k, name in enumerate(self.robots)}
        self._renderer = Renderer(WEBCAM, world.background)
        self._still = PanelSet.of(world.panels)
        self._looks = {name: body_panels(k) for k, name in enumerate(self.robots)}
        self._log: dict[str, list[Array]] = {name: [] for name in self.robots}
        self._remember()

    def __enter__(self) -> Simulation:
        """Nothing more to do: it is built."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let the physics go."""
        self.close()

    def close(self) -> None:
        """Let the physics go. Twice is no error."""
        self._physics.close()

    @property
    def stamp_ns(self) -> int:
        """Simulated time."""
        return self.tick * TICK_NS

    def describe(self, name: str) -> RobotDescription:
        """What the robot's agent may know of its body."""
        self._body(name)
        return self._description

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
            self._body(name)
        start = time.perf_counter()
        for name, body in self._bodies.items():
            body.drive(commands.get(name, Command()))
        for _ in range(SUBSTEPS):
            for body in self._bodies.values():
                body.substep(self._description.tick / SUBSTEPS)
            self._physics.stepSimulation()
        for body in self._bodies.values():
            body.settle()
        self.tick += 1
        self._remember()
        self.seconds["physics"] += time.perf_counter() - start

    def observe(self, name: str) -> Observation:
        """What a robot senses now. Its odometry counts from its last observation."""
        body = self._body(name)
        start = time.perf_counter()
        image = self._image(name)
        middle = time.perf_counter()
        proximity = self._ranges(name)
        self.seconds["render"] += middle - start
        self.seconds["rangers"] += time.perf_counter() - middle
        return Observation(self.stamp_ns, body.odometry(), image, proximity, body.bumped)

    def kidnap(self, name: str, pose: Pose2) -> None:
        """Pick a robot up and put it down elsewhere (`world_from_robot`); its encoders do not notice."""
        self._body(name).put(pose)

    def truth(self, name: str) -> Pose2:
        """Where a robot really is, `world_from_robot`."""
        return self._body(name).pose

    def truth_at(self, name: str, stamp_ns: int) -> Pose2:
        """Where a robot really was at a tick.

        Raises:
            InvalidValue: a time that was not simulated.
        """
        self._body(name)
        tick = stamp_ns // TICK_NS
        if not 0 <= tick <= self.tick:
            raise InvalidValue(f"{stamp_ns} ns is not between 0 and {self.stamp_ns} ns")
        return Pose2.from_vector(self._log[name][tick])

    def trajectory(self, name: str) -> tuple[NDArray[np.int64], Array]:
        """(N,) ns and (N, 3) [x m, y m, heading rad] in world, one a tick from the start."""
        self._body(name)
        return np.arange(self.tick + 1, dtype=np.int64) * TICK_NS, np.array(self._log[name])

    def collisions(self, name: str) -> int:
        """How often a robot has run into something."""
        return self._body(name).collisions

    def _body(self, name: str) -> Body:
        if name not in self._bodies:
            raise InvalidValue(f"no robot {name!r}; there are {', '.join(self.robots)}")
        return self._bodies[name]

    def _build_world(self) -> int:
        p = self._physics
        floor = int(p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE)))
        p.changeDynamics(floor, -1, lateralFriction=1.0)
        for block in self.world.blocks:
            base, height = block.base, block.top - block.bottom
            shape = p.createCollisionShape(
                p.GEOM_BOX, halfExtents=[base.length / 2, base.width / 2, height / 2]
            )
            p.createMultiBody(
                0, shape, -1, [base.x, base.y, block.bottom + height / 2],
                p.getQuaternionFromEuler([0, 0, base.heading]),
            )  # fmt: skip
        return floor

    def _image(self, name: str) -> NDArray[np.uint8]:
        position, rotation = self._body(name).posture()
        others = [
            self._looks[other].placed(turn, at)
            for other in self.robots
            if other != name
            for at, turn in [self._bodies[other].posture()]
        ]
        panels = PanelSet.joined([self._still, *others]) if others else self._still
        image = self._renderer.render(panels, rotation, position)
        read = self._noise[name].standard_normal(image.shape, dtype=np.float32)
        read *= READ_OUT_NOISE
        read += image
        read += 0.5  # what follows rounds down
        return np.clip(read, 0.0, 255.0, out=read).astype(np.uint8)

    def _ranges(self, name: str) -> Array:
        """(K,) m from the robot's edge."""
        description, pose = self._description, self._body(name).pose
        angles = pose.heading + np.array(description.ranger_bearings)
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
        origin = np.array([pose.x, pose.y, RANGER_HEIGHT])
        reach = description.ranger_reach
        start = origin + directions * (description.radius + RANGER_GAP)
        end = origin + directions * (description.radius + reach)
        hits = self._physics.rayTestBatch(start.tolist(), end.tolist())
        shares = np.array([hit[2] for hit in hits])
        ranges = RANGER_GAP + shares * (reach - RANGER_GAP)
        ranges = ranges * (1.0 + RANGE_NOISE * self._noise[name].standard_normal(len(ranges)))
        return np.where(shares >= 1.0, reach, np.clip(ranges, 0.0, reach))

    def _remember(self) -> None:
        for name, body in self._bodies.items():
            self._log[name].append(body.pose.vector)
