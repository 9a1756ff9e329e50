"""Who drives in benchmarks.appearance: by bearings, with depths known, and straight at the epipole."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from agent.homing.guesses import Guesses
from agent.homing.trail import TrailSettings
from agent.observation import Command, Odometry
from agent.servo.appearance import AppearanceServo
from agent.servo.supervisor import Servo
from benchmarks.servo.world import (
    CAMERA,
    ROBOT,
    PoseFilter,
    Task,
    in_view,
)
from hybridmap.pose import Array, Pose2, PoseGaussian
from hybridmap.recognising.bearings import BearingFix, BearingSettings, relate, relate_all

_DEPTH_SHARE = 0.03
_NOTHING = np.zeros((0, 2))


class Driver(Protocol):
    """Drives a robot to a goal; sees it from the true posture, and uses that for nothing else."""

    def command(self, true_pose: Pose2) -> Command | None:
        """What to do after the image from there, or None when it has arrived."""
        ...

    def move(self, way: float, turn: float) -> None:
        """What the robot did, m and rad, of which the wheels measure something."""
        ...


class Eye:
    """Takes images: which landmarks are in view, and where, with noise."""

    def __init__(self, task: Task, sigma_px: float, rng: np.random.Generator) -> None:
        """Take the goal's view: (N, 2) px in `goal`."""
        self._points, self._sigma, self._rng = task.points, sigma_px, rng
        self.goal = CAMERA.project(task.points) + rng.normal(0.0, sigma_px, (len(task.points), 2))

    def look(self, true_pose: Pose2) -> tuple[NDArray[np.int64], Array]:
        """(K,) landmarks in view and (K, 2) px."""
        ids = np.flatnonzero(in_view(true_pose.vector, self._points))
        pixels = CAMERA.project(true_pose.inverse().apply(self._points[ids]))
        return ids, pixels + self._rng.normal(0.0, self._sigma, pixels.shape)


class Appearance:
    """agent.homing and agent.servo.appearance, as the robot uses them, without any idea where it begins."""

    def __init__(self, task: Task, sigma_px: float, rng: np.random.Generator) -> None:
        """Look at the goal."""
        self._eye, self._rng = Eye(task, sigma_px, rng), rng
        self._settings = TrailSettings(pixel_sigma=sigma_px, node_sigma=sigma_px)
        self._bearings = BearingSettings(pixel_sigma=sigma_px, least_inliers=4)
        self._count = len(task.points)
        self._servo = AppearanceServo(ROBOT)
        self._guesses: Guesses | None = None

    def command(self, true_pose: Pose2) -> Command | None:
        """One tick."""
        ids, pixels = self._eye.look(true_pose)
        fresh = self._guesses is None
        if self._guesses is None:
            fixes = relate_all(self._eye.goal[ids], CAMERA, pixels, CAMERA, self._rng, self._bearings)
            if not fixes:
                return Command()
            prior = PoseGaussian.from_sigmas(Pose2(), 2.0, 1.0)
            self._guesses = Guesses(ROBOT, CAMERA, self._eye.goal, fixes, prior, self._settings)
        self._guesses.see(ids, pixels)
        trail = self._guesses.trail
        visible = np.zeros(self._count, np.bool_)
        visible[ids] = True
        if fresh:
            self._servo.start(trail.pose, trail.points())
        step = self._servo.command(trail.pose, trail.points(), visible, _NOTHING)
        return None if step.state == "arrived" else step.command

    def move(self, way: float, turn: float) -> None:
        """Wheels that are off by two per cent and a little."""
        way += self._rng.normal(0.0, 0.02 * abs(way) + 1e-4)
        turn += self._rng.normal(0.0, 0.02 * abs(turn) + 2e-4)
        if self._guesses is not None:
            self._guesses.move(Odometry(way, turn))


class WithDepths:
    """agent.servo.supervisor, which knows the depths of what the goal's view shows to three per cent."""

    def __init__(self, task: Task, sigma_px: float, rng: np.random.Generator) -> None:
        """Look at the goal."""
        goal = Eye(task, sigma_px, rng).goal
        depths = task.points[:, 0] - CAMERA.mount_forward
        depths = depths * (1.0 + rng.normal(0.0, _DEPTH_SHARE, len(depths)))
        self._points = CAMERA.back_project(goal, depths)
        self._filter = PoseFilter(task, rng, self._points)
        self._servo = Servo(ROBOT)
        self._started = False

    def command(self, true_pose: Pose2) -> Command | None:
        """One tick."""
        visible = self._filter.see(true_pose)
        if not self._started:
            self._servo.start(self._filter.pose, self._points)
            self._started = True
        step = self._servo.command(self._filter.pose, self._points, visible, _NOTHING)
        return None if step.state == "arrived" else step.command

    def move(self, way: float, turn: float) -> None:
        """Wheels like everybody's."""
        self._filter.move(way, turn)


class Epipole:
    """Naive homing: turn to where the goal lies, drive until there is no parallax left, turn to its heading.

    Each tick it relates its view to the goal's anew. It knows no field of view, and backs where the goal lies
    behind it.
    """

    def __init__(self, task: Task, sigma_px: float, rng: np.random.Generator) -> None:
        """Look at the goal."""
        self._eye, self._rng = Eye(task, sigma_px, rng), rng
        self._settings = BearingSettings(pixel_sigma=sigma_px, least_inliers=4)
        self._there = 0
        self._before = Command()

    def command(self, true_pose: Pose2) -> Command | None:
        """One tick."""
        ids, pixels = self._eye.look(true_pose)
        goal = self._eye.goal[ids]
        fix = relate(goal, CAMERA, pixels, CAMERA, self._rng, self._settings)
        if fix is None:
            return self._before
        if not fix.directed:
            self._there += abs(fix.heading) < 0.01
            turn = -2.0 * fix.heading
            return None if self._there > 3 else Command(0.0, _clip(turn, ROBOT.max_turn))
        self._there = 0
        toward = fix.direction + math.pi - fix.heading
        toward = math.remainder(toward, 2.0 * math.pi)
        sense = 1.0 if abs(toward) < 0.5 * math.pi else -1.0
        error = toward if sense > 0 else math.remainder(toward - math.pi, 2.0 * math.pi)
        speed = sense * min(2.0 * _parallax(fix), ROBOT.max_forward) * max(math.cos(error), 0.0) ** 3
        self._before = Command(speed, _clip(2.0 * error, ROBOT.max_turn))
        return self._before

    def move(self, way: float, turn: float) -> None:
        """It looks at no wheels."""


def _parallax(fix: BearingFix) -> float:
    """Baseline over the median depth: an angle, rad."""
    return float(np.nanmedian(np.maximum(fix.inverse_depths, 0.0)))


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


DRIVERS: dict[str, Callable[[Task, float, np.random.Generator], Driver]] = {
    "appearance": Appearance,
    "servo_with_depths": WithDepths,
    "epipole_homing": Epipole,
}
