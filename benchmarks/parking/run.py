"""One parking of the benchmark: put down, find itself, park; what was seen, and what is true."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from benchmarks.parking.scene import ROBOT, ParkingScene
from mapweave.agent.localization.fix import position_sigma
from mapweave.agent.mission import ServerAnswer
from mapweave.agent.navigation.navigator import Navigator
from mapweave.agent.navigation.route_follower import RouteProgress
from mapweave.agent.servo.proximity import guard
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle
from mapweave.sim.simulation import Simulation
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

TIME_LIMIT = 60.0
"""s from being put down."""
POSITION, HEADING = 0.01, math.radians(1.0)
"""A robot within this of the goal has parked, m and rad."""
LEAST_VISIBLE = 4
"""Landmarks of the goal that must be in view while the robot servos."""
REST = 5
"""Ticks after the robot says that it has arrived, until it really stands."""


@dataclass
class Record:
    """What happened, a row a tick.

    Attributes:
        true: (T, 3) goal_from_robot as it is: x m, y m, heading rad.
        believed: (T, 3) as the robot believes; NaN while it does not know, or knows itself by another node.
        pixels: (T, N, 2) px where the goal's landmarks are tracked, NaN where they are not.
        seen: (T,) how many of them are in the image by the truth.
        doing: (T,) in words.
    """

    true: list[Array] = field(default_factory=list)
    believed: list[Array] = field(default_factory=list)
    pixels: list[Array] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    doing: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class ParkingOutcome:
    """One parking.

    Attributes:
        start: goal_from_robot where the robot was put down.
        arrived: whether it says that it has parked, within the time limit.
        success: whether that is true, nothing was touched, and enough was in view all the time.
        reason: why there is no success, in words; empty if there is.
        error_m: distance from the goal at the end.
        error_deg: of the heading.
        believed_m: what the robot believes its distance from the goal to be.
        sigma_m: standard deviation that it gives its position, in the direction in which it knows it least;
            NaN where it does not know itself by the goal.
        nees: normalised squared error of the pose that it believes, 3 if its covariance is right; NaN there.
        time_s: until it arrived or the time was over.
        path_ratio: way over the shortest one that keeps the landmarks in view.
        switches: how often another law or leg has taken the wheels.
        violations: ticks of servoing with fewer landmarks in view than there must be.
        collisions: with anything.
        record: of it all.
    """

    start: Pose2
    arrived: bool
    success: bool
    reason: str
    error_m: float
    error_deg: float
    believed_m: float
    sigma_m: float
    nees: float
    time_s: float
    path_ratio: float
    switches: int
    violations: int
    collisions: int
    record: Record


def park(scene: ParkingScene, start: Pose2, shortest: float, seed: int) -> ParkingOutcome:
    """Put the robot down at a start, `goal_from_robot`, and let it park.

    Args:
        scene: with the goal.
        start: where it is put down.
        shortest: length of the shortest path, m.
        seed: of the robot's own chance.
    """
    description, lens = scene.description, Lens(scene.description.camera, scene.description.distortion)
    navigator = Navigator(description, lens, Sift(lens), scene.own_map, scene.goal.id, seed=seed)
    record, answers = Record(), list[ServerAnswer]()
    with scene.simulate(scene.world_from_goal @ start) as simulation:
        observation = simulation.observe(ROBOT)
        for _ in range(round(TIME_LIMIT / description.tick)):
            command, questions = navigator.step(observation, tuple(answers))
            answers = [scene.answer(question) for question in questions]
            _note(record, scene, _true(scene, simulation), navigator)
            if navigator.arrived:
                break
            safe, _ = guard(command, observation.proximity, description)
            observation = simulation.step({ROBOT: safe})[ROBOT]
        for _ in range(REST):
            simulation.advance({})
        off, collisions = _true(scene, simulation), simulation.collisions(ROBOT)
    believed, fix = record.believed[-1], navigator.fix
    known = fix if fix is not None and fix.node == scene.goal.id else None
    error_m, error = math.hypot(off.x, off.y), abs(wrap_angle(off.heading))
    parking = [doing.startswith(RouteProgress.PARKING) for doing in record.doing]
    violations = sum(p and n < LEAST_VISIBLE for p, n in zip(parking, record.seen, strict=True))
    complaints = [] if navigator.arrived else [f"not parked after {TIME_LIMIT:g} s: {record.doing[-1]}"]
    if navigator.arrived and (error_m > POSITION or error > HEADING):
        complaints.append("parked elsewhere")
    if violations:
        complaints.append(f"{violations} ticks with fewer than {LEAST_VISIBLE} landmarks in view")
    if collisions:
        complaints.append(f"{collisions} collisions")
    way = np.diff(np.array(record.true)[:, :2], axis=0)
    return ParkingOutcome(
        start=start,
        arrived=navigator.arrived,
        success=not complaints,
        reason="; ".join(complaints),
        error_m=error_m,
        error_deg=math.degrees(error),
        believed_m=float(np.hypot(*believed[:2])),
        sigma_m=math.nan if known is None else position_sigma(known.node_from_robot),
        nees=math.nan if known is None else known.node_from_robot.mahalanobis2(off),
        time_s=len(record.doing) * description.tick,
        path_ratio=float(np.hypot(way[:, 0], way[:, 1]).sum()) / shortest,
        switches=_switches(record.doing),
        violations=violations,
        collisions=collisions,
        record=record,
    )


def _true(scene: ParkingScene, simulation: Simulation) -> Pose2:
    return scene.world_from_goal.inverse() @ simulation.truth(ROBOT)


def _note(record: Record, scene: ParkingScene, true: Pose2, navigator: Navigator) -> None:
    fix = navigator.fix
    pixels, believed = np.full((len(scene.goal.landmarks), 2), np.nan), np.full(3, np.nan)
    if fix is not None and fix.node == scene.goal.id:
        believed = fix.node_from_robot.mean.vector
        if fix.localizer is not None:
            pixels[fix.localizer.visible] = fix.localizer.pixels
    record.true.append(np.array([true.x, true.y, wrap_angle(true.heading)]))
    record.believed.append(believed)
    record.pixels.append(pixels)
    record.seen.append(scene.seen(true))
    record.doing.append(f"{navigator.stage}: {navigator.detail}")


def _switches(doing: list[str]) -> int:
    """How often the law or the leg that drives has changed, by what the robot says."""
    drives = [
        words.split(":", 1)[1].split(",")[0] for words in doing if words.startswith(RouteProgress.PARKING)
    ]
    drives = [words.replace("turning to ", "") for words in drives if "law" in words or "leg" in words]
    return sum(a != b for a, b in pairwise(drives))
