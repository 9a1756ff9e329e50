"""Driving to a position between nodes: around what the rangers have seen on the way."""

from __future__ import annotations

import math

import numpy as np

from mapweave.agent.navigation.grid_planner import GridPlanner
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.servo.dynamic_window import DynamicWindow
from mapweave.agent.servo.proximity import ranger_points
from mapweave.agent.settings import NavigatorSettings, OccupancyGridSettings
from mapweave.hybridmap.pose import Array, Pose2

AROUND = OccupancyGridSettings(cell=0.05, side=6.4)
"""The grid that moves along with the robot, which stands in its middle."""
REPLAN_EVERY = 5
"""Ticks between two plans."""
LEAST = 0.065
"""Clearance around the footprint that a way needs, m."""
WISHED = 0.2
"""Clearance above which more has no value, m."""
AHEAD = 0.6
"""Largest distance of the point of the way that it steers to, m."""


class LocalPlanner:
    """Keeps a local occupancy grid in the odometry frame.

    That frame drifts, but the grid is needed for a few metres only.
    """

    def __init__(self, description: RobotDescription, settings: NavigatorSettings | None = None) -> None:
        """Start with an unknown grid."""
        self._settings = settings or NavigatorSettings()
        self._description = description
        self._floor = OccupancyGrid(description, AROUND)
        self._arcs = DynamicWindow(description)
        self._odom_from_robot = Pose2()
        self._way: Array = np.zeros((0, 2))
        self._points: Array = np.zeros((0, 2))
        self._tick = 0
        self._replan_at = 0

    @property
    def around(self) -> bool:
        """Whether the way leads around something."""
        return bool(len(self._way))

    def see(self, observation: Observation) -> None:
        """Take in what the robot senses, every tick."""
        self._tick += 1
        self._odom_from_robot = odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        self._floor.roll(np.array([odom_from_robot.x, odom_from_robot.y]))
        self._floor.see(odom_from_robot, observation.proximity)
        self._points = ranger_points(observation.proximity, self._description)

    def toward(self, robot_from_target: Pose2) -> Command:
        """Turn toward a position, then drive to it.

        Args:
            robot_from_target: where it is; its heading does not matter.
        """
        s, odom_from_robot = self._settings, self._odom_from_robot
        start = np.array([odom_from_robot.x, odom_from_robot.y])
        goal = odom_from_robot.apply(np.array([robot_from_target.x, robot_from_target.y]))
        if self._tick >= self._replan_at:
            self._replan_at = self._tick + REPLAN_EVERY
            self._way = self._plan(start, goal)
        ahead = odom_from_robot.inverse().apply(self._steered_to(start, goal))
        speed = min(s.speed, 0.8 * float(np.hypot(*ahead)))
        return self._arcs.toward(ahead, self._points, speed, s.turn_rate)

    def _plan(self, start: Array, goal: Array) -> Array:
        """(N, 2) m in odom, points of the way around; none if the straight way is free."""
        room = self._floor.room()
        least, wished = (self._description.radius + extra for extra in (LEAST, WISHED))
        # The robot is in the middle of the grid; beyond its border everything is unknown.
        goal = start + (goal - start) * min(1.0, 0.5 * AROUND.side / max(np.abs(goal - start).max(), 1e-9))
        count = int(np.hypot(*(goal - start)) / (0.5 * AROUND.cell)) + 2
        line = self._floor.cells(start + np.linspace(0.0, 1.0, count)[:, None] * (goal - start))
        if (room[line[:, 0], line[:, 1]] >= 0.5 * (least + wished)).all():
            return np.zeros((0, 2))
        first, last = self._floor.cells(np.stack([start, goal]))
        here, there = (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))
        cells = GridPlanner(room, here, least, wished, there).way_to(there)
        return np.array([self._floor.centre((int(a), int(b))) for a, b in cells[1:]]).reshape(-1, 2)

    def _steered_to(self, start: Array, goal: Array) -> Array:
        """(2,) m in odom: the furthest point of the way up to which a straight line stays near the way."""
        if not len(self._way):
            return goal
        nearest = int(np.hypot(*(self._way - start).T).argmin())
        offsets = self._way[nearest:] - start
        chosen = 0
        for k in range(1, len(offsets)):
            length = math.hypot(*offsets[k])
            if length > AHEAD:
                break
            aside = offsets[:k] @ np.array([-offsets[k, 1], offsets[k, 0]]) / max(length, 1e-9)
            if np.abs(aside).max() > AROUND.cell:
                break
            chosen = k
        return np.asarray(start + offsets[chosen])
