"""Driving to a position between nodes: straight, or around what the rangers have seen in between."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agent.floor import Floor
from agent.observation import Command, Observation, RobotDescription
from hybridmap.pose import Array, Pose2


@dataclass(frozen=True)
class DetourSettings:
    """How the robot drives between nodes.

    Attributes:
        speed: m/s.
        turn_rate: rad/s.
        aligned: it drives at full speed when it faces its way, and not at all when off by this, rad.
        replan_every: ticks between two plans.
        tight: with something ahead nearer than this to its edge the robot backs off first, m: beside a wall
            that it almost touches, the guard lets it move nowhere but away.
        back_off: speed of that, m/s.
        corner: a corner of the way is passed within this distance, m.
    """

    speed: float = 0.26
    turn_rate: float = 0.6
    aligned: float = 0.4
    replan_every: int = 15
    corner: float = 0.08
    tight: float = 0.07
    back_off: float = 0.08


class Detour:
    """Remembers what the rangers have seen since it was made, in the wheels' own frame.

    That frame drifts, but the memory has to serve for a few metres only.
    """

    def __init__(self, description: RobotDescription, settings: DetourSettings | None = None) -> None:
        """Know nothing of the floor yet."""
        self._settings = settings or DetourSettings()
        self._floor = Floor(description)
        self._odom_from_robot = Pose2()
        self._corners: list[Array] = []
        self._bearings = np.array(description.ranger_bearings)
        self._proximity: Array = np.zeros(0)
        self._tick = 0
        self._replan_at = 0

    @property
    def around(self) -> bool:
        """Whether the way leads around something."""
        return bool(self._corners)

    def see(self, observation: Observation) -> None:
        """Take in what the robot senses, every tick."""
        self._tick += 1
        self._odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        self._floor.see(self._odom_from_robot, observation.proximity)
        self._proximity = observation.proximity

    def toward(self, robot_from_target: Pose2) -> Command:
        """Turn toward a position, then drive to it.

        Args:
            robot_from_target: where it is; its heading does not matter.
        """
        s, here = self._settings, self._odom_from_robot
        if self._cornered():
            return Command(-s.back_off, 0.0)
        start = np.array([here.x, here.y])
        goal = here.apply(np.array([robot_from_target.x, robot_from_target.y]))
        while self._corners and np.linalg.norm(self._corners[0] - start) < s.corner:
            self._corners.pop(0)
        blocked = bool(self._corners) and not self._floor.clear(start, self._corners[0])
        if blocked or self._tick >= self._replan_at:
            self._replan_at = self._tick + s.replan_every
            reach = 2.0 * float(np.linalg.norm(goal - start)) + 1.0
            straight = self._floor.clear(start, goal)
            self._corners = [] if straight else self._floor.corners(start, goal, reach)
        ahead = here.inverse().apply(self._corners[0] if self._corners else goal)
        error = math.atan2(ahead[1], ahead[0])
        speed = min(s.speed, 0.8 * float(np.linalg.norm(ahead))) * max(0.0, 1.0 - abs(error) / s.aligned)
        return Command(speed, float(np.clip(1.8 * error, -s.turn_rate, s.turn_rate)))

    def _cornered(self) -> bool:
        """Whether something ahead is so near that the robot must back off, and nothing is behind."""
        if len(self._proximity) != len(self._bearings) or not len(self._bearings):
            return False
        ahead = np.cos(self._bearings) > 0.3
        behind = np.cos(self._bearings) < -0.3
        tight = self._settings.tight
        return bool(self._proximity[ahead].min() < tight and self._proximity[behind].min() > 2 * tight)
