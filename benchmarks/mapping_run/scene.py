"""A simulated mapping run: a robot looks at a wall, drives back and forth, and follows what it sees.

The camera's pictures are rendered, features are SIFT's, tracks Lucas-Kanade's and the estimates those of
`mapweave.agent.mapping.tracking`, all as a robot runs them; the drive closes its loop on the estimate. Truth
is written down beside it, and used for the start alone: a robot that shall look at something must stand
before it.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.images.surface_points import Surfaces
from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.exploration.behaviours import DRIVE, LEAST_FEATURES
from mapweave.agent.mapping.anchored_keyframe import HERE
from mapweave.agent.mapping.mapper import DEPTHS_PER_HEIGHT
from mapweave.agent.mapping.tracking import Tracking
from mapweave.agent.mapping.view import PendingKeyframe
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.agent.servo.image_drive import ImageDrive
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.sim.events import Walk
from mapweave.sim.placement import is_clear
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from synthetic.mapping_run import speeds

NAME = "r0"
SPEED = 0.15
"""Of the drive, m/s."""
NEAREST, FARTHEST = 1.5, 5.0
"""What the robot looks at is so far ahead, m."""
WALK_FROM, WALK_FOR = 0.3, 0.4
"""A person walks past after this share of the run, and for this share of it."""


@dataclass(frozen=True, eq=False)
class RunTick:
    """One tick of a run.

    Attributes:
        odometry: what the encoders say since the tick before.
        true: anchor_from_robot, by the simulator.
        wheels: anchor_from_robot, by the encoders alone.
        pose: anchor_from_robot, as the robot believes.
        landmarks: in robot, as the robot believes.
        ids: (N,) tracks alive.
        pixels: (N, 2) px, where they are.
        believed: whether the image was taken for a continuation of the one before.
        person: bearing of a person in view, rad, positive to the left; NaN without one.
        step_ms: wall time of tracking and filtering.
    """

    odometry: Odometry
    true: Pose2
    wheels: Pose2
    pose: PoseGaussian
    landmarks: LandmarkEstimates
    ids: NDArray[np.int64]
    pixels: Array
    believed: bool
    person: float
    step_ms: float


@dataclass(frozen=True, eq=False)
class MappingDrive:
    """A whole run.

    Attributes:
        name: of the run.
        robot: as its agent knows it.
        world: where it happened.
        world_from_anchor: true.
        ids: (N,) tracks that began at the anchor, ascending.
        points: (N, 3) m, in the anchor's robot frame: where they truly are; NaN if nothing is there.
        flat: (N,) whether the patch of a track is on one surface, so that it is one point.
        moments: one a tick; the first is the anchor.
        images: (H, W) by the number of the moment: at the anchor, where a person is in the middle of the
            view or else farthest from the anchor, at the end.
        given_up: why the robot would have dropped the episode, in words; then the run ends there.
    """

    name: str
    robot: RobotDescription
    world: World
    world_from_anchor: Pose2
    ids: NDArray[np.int64]
    points: Array
    flat: NDArray[np.bool_]
    moments: tuple[RunTick, ...]
    images: dict[int, NDArray[np.uint8]]
    given_up: str

    @property
    def seconds(self) -> Array:
        """(T,) s since the anchor."""
        return self.robot.tick * np.arange(len(self.moments), dtype=np.float64)

    def truth(self, ids: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Points (N, 3) m in the anchor's robot frame and whether each is flat, of tracks (N,).

        Of a track that did not begin at the anchor nothing is known: NaN, and not flat.
        """
        known = np.isin(ids, self.ids)
        rows = np.searchsorted(self.ids, ids[known])
        points, flat = np.full((len(ids), 3), np.nan), np.zeros(len(ids), np.bool_)
        points[known], flat[known] = self.points[rows], self.flat[rows]
        return points, flat


def drive(
    seed: int,
    kind: str,
    shape: str,
    steps: int,
    person: bool = False,
    progress: Callable[[], None] = lambda: None,
) -> MappingDrive:
    """Simulate a run.

    Args:
        seed: of the world, the start, wheels, slip and the camera's noise.
        kind: of world, see mapweave.sim.worlds.catalog.
        shape: of the drive, one of synthetic.mapping_run.SHAPES.
        steps: ticks.
        person: whether a person walks past.
        progress: called once a tick.

    Raises:
        InvalidValue: a world in which no robot can look at a wall with features.
    """
    world = make_world(kind, seed, **({"boxes": 6} if kind == "arena" else {}))
    setup = RobotSetup(NAME)
    for start in viewpoints(world, setup.describe(), seed):
        with Simulation(world, [setup], seed, [start]) as simulation:
            run = _Run(simulation)
            if len(run.anchor.features) < LEAST_FEATURES:
                continue
            run.go(shape, steps, person, progress)
            return run.recorded(f"{shape}, person" if person else shape)
    raise InvalidValue(
        f"in this {kind} no robot sees enough {NEAREST}-{FARTHEST} m ahead; try another --seed"
    )


def viewpoints(world: World, robot: RobotDescription, seed: int) -> Iterator[Pose2]:
    """Places (`world_from_robot`) with the way of the drive free and something to look at, by the truth."""
    rng = np.random.default_rng([seed, 0x5EE])
    surfaces, camera, radius = Surfaces(world), robot.camera, robot.radius + 0.05
    columns = np.linspace(0.0, camera.width - 1.0, 9)
    horizon = np.column_stack([columns, np.full(9, camera.cy)])
    for _ in range(300):
        pose = world.plan.random_free_pose(rng, radius)
        end = pose @ Pose2(DRIVE + 0.3)
        depths = surfaces.see(pose, camera, horizon).depths
        in_reach = (depths > NEAREST).all() and (depths < FARTHEST).all()
        if in_reach and is_clear(world.plan, [(pose.x, pose.y), (end.x, end.y)], radius):
            yield pose


class _Run:
    """A robot at its anchor view, and what is written down from there on."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.robot = simulation.describe(NAME)
        settings, lens = AgentSettings(), Lens(self.robot.camera, self.robot.distortion)
        self.tracking = Tracking(self.robot, lens, settings)
        # One tick for the wheels to settle on the floor.
        simulation.step({})
        observation = simulation.step({})[NAME]
        self.world_from_anchor = simulation.truth(NAME)
        self.anchor = self._begin(observation, Sift(lens, settings.sift))
        self.wheels = Pose2()
        self.moments: list[RunTick] = []
        self.images: list[NDArray[np.uint8] | None] = []
        self.given_up = ""
        self._write(Observation(observation.stamp_ns, Odometry(0.0, 0.0), observation.image), 0.0)

    def go(self, shape: str, steps: int, person: bool, progress: Callable[[], None]) -> None:
        """Drive back and forth; the shape adds turns to those that the image asks for."""
        turns = speeds(shape, steps)[1]
        reach = DRIVE
        controller = ImageDrive(self.robot, SPEED)
        controller.start(reach)
        observation: Observation | None = None
        aside = 0.0
        for tick, turn in enumerate(turns.tolist()):
            if person and tick == round(WALK_FROM * steps):
                self.simulation.apply(Walk(near=NAME, seconds=WALK_FOR * steps * self.robot.tick))
            pose = self.tracking.pose.mean
            bearings = self.robot.camera.bearings(self.tracking.pixels)
            proximity = np.zeros(0) if observation is None else observation.proximity
            # The drive holds the way as if the robot did not turn aside on purpose.
            command, done, _ = controller.command(pose.x, pose.heading - aside, bearings + aside, proximity)
            if done:
                controller.start(reach)
            command = Command(command.forward, command.turn + turn)
            aside += turn * self.robot.tick
            observation = self.simulation.step({NAME: command})[NAME]
            before = time.perf_counter()
            self.tracking.step(observation)
            step_ms = 1e3 * (time.perf_counter() - before)
            self.wheels = self.wheels @ observation.odometry.motion()
            self._write(observation, step_ms)
            progress()
            if self.tracking.acceptance.carried_off or self.tracking.disputed:
                carried_off = self.tracking.acceptance.carried_off
                self.given_up = "carried off" if carried_off else "wheels against image"
                return

    def recorded(self, name: str) -> MappingDrive:
        """What was written down."""
        surfaces, camera = Surfaces(self.simulation.world), self.robot.camera
        pixels = self.anchor.features.pixels
        seen = surfaces.see(self.world_from_anchor, camera, pixels)
        return MappingDrive(
            name, self.robot, self.simulation.world, self.world_from_anchor, self.anchor.tracks,
            self.world_from_anchor.inverse().apply(seen.points),
            surfaces.flat(self.world_from_anchor, camera, pixels),
            tuple(self.moments), self._telling(), self.given_up,
        )  # fmt: skip

    def _begin(self, observation: Observation, sift: Sift) -> PendingKeyframe:
        """Make the image the anchor view of an episode, as the mapper does."""
        if observation.image is None:
            raise InvalidValue("the camera gave no first image")
        self.tracking.step(observation)
        view = self.tracking.take(observation, sift.extract(observation.image), HERE)
        self.tracking.reanchor()
        self.tracking.follow(view)
        self.tracking.fill(DEPTHS_PER_HEIGHT * self.robot.camera.mount_height)
        return view

    def _write(self, observation: Observation, step_ms: float) -> None:
        world_from_robot = self.simulation.truth(NAME)
        moment = RunTick(
            observation.odometry, self.world_from_anchor.inverse() @ world_from_robot, self.wheels,
            self.tracking.pose, self.tracking.landmarks(), self.tracking.ids.copy(),
            self.tracking.pixels.copy(), not self.tracking.acceptance.doubtful,
            self._person(world_from_robot), step_ms,
        )  # fmt: skip
        self.moments.append(moment)
        self.images.append(observation.image)

    def _telling(self) -> dict[int, NDArray[np.uint8]]:
        """The first image, the last, and one between: a person in the middle of it, or the end of a way."""
        numbers = [k for k, image in enumerate(self.images) if image is not None]
        between = max(numbers, key=lambda k: self._worth(self.moments[k]))
        return {k: image for k, image in enumerate(self.images) if image is not None and k in
                (numbers[0], between, numbers[-1])}  # fmt: skip

    def _worth(self, moment: RunTick) -> float:
        alone = math.isnan(moment.person)
        return math.hypot(moment.true.x, moment.true.y) if alone else 10.0 - abs(moment.person)

    def _person(self, world_from_robot: Pose2) -> float:
        """Bearing of the nearest actor whose middle is in view, rad; NaN if there is none."""
        for actor in self.simulation.snapshot().actors:
            at = world_from_robot.inverse().apply(np.array([actor.x, actor.y]))
            bearing = math.atan2(at[1], at[0])
            if abs(bearing) <= self.robot.camera.semi_aperture:
                return bearing
        return math.nan
