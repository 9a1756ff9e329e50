"""The appearance-based servo: parks at a view of which only bearings are known (the paper's future work).

What two views tell is the place up to its scale, and a way that keeps landmarks in view at one scale keeps
them in view at any: visibility is a matter of angles. So the servo for known depths plans on what a trail
(agent.homing) makes of the bearings so far, slowly until a few centimetres of wheels have told the scale; its
plan is mended as the landmarks' depths emerge on the way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.observation import Command, RobotDescription
from agent.servo.follow import clip
from agent.servo.laws import saturate
from agent.servo.settings import ServoSettings
from agent.servo.step import ServoStep
from agent.servo.supervisor import Servo
from hybridmap.pose import Array, Pose2, PoseGaussian


@dataclass(frozen=True, slots=True)
class AppearanceSettings:
    """Settings of the appearance-based servo.

    Attributes:
        servo: of the servo that drives.
        unsure: the scale counts as unknown while the standard deviation of the way that is left is more
            than this share of it.
        tentative: speed until then, m/s.
        least_seen: landmarks without which nothing is driven.
        lost_ticks: so many images in a row may show fewer before it is said.
        exact: an arrival known no better than this is told as such, m.
        patience: s without getting nearer or surer after which a goal that is nearer than twice what is
            known of it counts as reached: there is nothing more to see.
        settled: rad, where one landmark would be seen so far off from where it was believed, the way is
            thought over anew; for less, a plan would be mended all the time.
    """

    servo: ServoSettings = field(default_factory=lambda: ServoSettings(field_margin=0.08))
    unsure: float = 0.35
    tentative: float = 0.1
    least_seen: int = 4
    lost_ticks: int = 10
    exact: float = 0.01
    patience: float = 10.0
    settled: float = 0.02


class AppearanceServo:
    """Parks the robot at a place known by bearings. One for each drive: `start` begins anew."""

    def __init__(self, description: RobotDescription, settings: AppearanceSettings | None = None) -> None:
        """Prepare for a robot."""
        self.settings = settings or AppearanceSettings()
        self._description = description
        self._servo = Servo(description, self.settings.servo)
        self._lost = 0
        self._best, self._waited = math.inf, 0.0
        self._points: Array = np.zeros((0, 3))

    @property
    def switches(self) -> int:
        """How often another law or plan has taken the wheels."""
        return self._servo.switches

    def start(self, goal_from_robot: PoseGaussian, points_in_goal: Array) -> bool:
        """Take a new goal; see Servo.start."""
        self._lost = 0
        self._best, self._waited = math.inf, 0.0
        self._points = points_in_goal
        return self._servo.start(goal_from_robot.mean, points_in_goal)

    def command(
        self,
        goal_from_robot: PoseGaussian,
        points_in_goal: Array,
        visible: NDArray[np.bool_],
        obstacles: Array,
    ) -> ServoStep:
        """One tick.

        Args:
            goal_from_robot: what is known of where the robot is, in the goal's robot frame.
            points_in_goal: (N, 3) m, what is known of the landmarks, likewise; NaN for those never seen.
            visible: (N,) which are tracked now.
            obstacles: (K, 2) m, in robot, points that the rangers hit now.
        """
        s, pose = self.settings, goal_from_robot.mean
        self._lost = 0 if int(np.count_nonzero(visible)) >= s.least_seen else self._lost + 1
        if self._lost > s.lost_ticks:
            words = f"fewer than {s.least_seen} of the place's landmarks are in view"
            return ServoStep(Command(), "stuck", None, words, 0)
        left, sigma = math.hypot(pose.x, pose.y), self.spread(goal_from_robot)
        self._wait(left + sigma)
        if self._waited > s.patience and left < 2.0 * sigma and sigma > s.exact:
            return self._face(pose, sigma)
        if self._moved(pose, points_in_goal):
            # The robot stands elsewhere too: lines drawn from where it was thought to be are wrong.
            self._points = points_in_goal
            self._servo.start(pose, points_in_goal)
        step = self._servo.command(pose, self._points, visible, obstacles)
        if step.state == "arrived":
            return self._arrived(step, sigma)
        if sigma > s.unsure * max(left, 0.05) and step.command.forward != 0.0:
            slow = saturate(
                step.command.forward,
                step.command.turn,
                min(s.tentative, self._description.max_forward),
                max(self._description.max_turn, 1e-3),
            )
            words = f"{step.reason}, slowly: how far it is is not known yet"
            return ServoStep(Command(*slow), step.state, step.law, words, step.predicted_visible)
        return step

    @staticmethod
    def spread(goal_from_robot: PoseGaussian) -> float:
        """Largest standard deviation of the position, m."""
        return math.sqrt(max(float(np.linalg.eigvalsh(goal_from_robot.covariance[:2, :2])[-1]), 0.0))

    def _moved(self, pose: Pose2, points: Array) -> bool:
        """Whether landmarks are no longer where the servo believes them, as seen from a posture."""
        if points.shape != self._points.shape:
            return True
        before, now = (pose.inverse().apply(where) for where in (self._points, points))
        off = np.arctan2(now[:, 1], now[:, 0]) - np.arctan2(before[:, 1], before[:, 0])
        off = np.abs(np.remainder(off + math.pi, 2.0 * math.pi) - math.pi)
        # What was never seen is NaN on both sides.
        same = (off <= self.settings.settled) | (np.isnan(now[:, 0]) & np.isnan(before[:, 0]))
        return not bool(same.all())

    def _wait(self, off: float) -> None:
        """Count for how long the goal has come no nearer, or been known no better: `off` m in all."""
        if off < 0.9 * self._best:
            self._best, self._waited = off, 0.0
        self._waited += self._description.tick

    def _face(self, pose: Pose2, sigma: float) -> ServoStep:
        """Where bearings tell no position any more they still tell the heading."""
        s = self.settings.servo
        if abs(pose.heading) > s.heading_tolerance:
            turn = clip(-s.turn_gain * pose.heading, self._description.max_turn)
            return ServoStep(Command(0.0, turn), "turning", None, "turning to the goal's heading", 0)
        return self._arrived(ServoStep(Command(), "arrived", None, "at the goal", 0), sigma)

    def _arrived(self, step: ServoStep, sigma: float) -> ServoStep:
        if sigma <= self.settings.exact:
            return step
        words = f"at the goal as far as bearings tell: within {2.0 * sigma:.2f} m"
        return ServoStep(step.command, "arrived", None, words, step.predicted_visible)
