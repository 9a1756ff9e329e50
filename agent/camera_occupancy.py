"""Occupancy grid of a robot without proximity sensors: where it drove, and past what its camera saw.

Space carving: a ray of light between the camera and a landmark meets nothing. Landmarks at or below the
camera's height show that the floor before them is free at the height of the robot; higher ones show nothing.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.observation import RobotDescription
from mapweave.agent.occupancy_grid import DECIDED, HIT, MISS, MOST, OccupancyGrid
from mapweave.agent.settings import OccupancyGridSettings
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2

BEARINGS = tuple(k * math.tau / 24 for k in range(24))
"""Directions in which the grid is read as if by proximity sensors, rad."""
REACH = 3.0
"""m, of these readings and of what a view shows: depths of small parallax are not known well further away."""
BIN = math.radians(2.0)
"""Landmarks this near to each other in bearing show the same thing, rad."""
GAP = 0.3
"""Between two neighbouring landmarks the floor counts as free where they are not further apart, m: a thing
without texture that is no wider may stand between them."""
FLOOR = 0.04
"""Landmarks below this height are on the floor, m."""
OVERHANG = 2.0
"""Landmarks up to so many heights of the camera may belong to something that the robot would touch."""
SIGMAS = 2.0
"""A landmark is taken so many sigmas of its depth nearer."""
SURE = 0.1
"""A landmark known no better than this does not say where something is, m."""
SLACK = 0.15
"""Readings end this far beyond the border of the known floor, m: behaviours keep 0.12 m to what is read."""
DARED = 0.42
"""The same ahead, where the camera looks, m: a view without known floor is mapped on a drive of 0.3 m."""
NEAR = 1.5
"""Landmarks of the filter within this are entered before there is a node, m."""
EVERY = 5
"""Ticks between two entries of them."""
WIDTH = 0.5
"""Half of the arc ahead of the footprint that counts as occupied where it touched something, rad."""


class CameraOccupancyGrid(OccupancyGrid):
    """Free is what was driven over or seen past; occupied is what landmarks lie on and what was touched."""

    def __init__(self, description: RobotDescription, settings: OccupancyGridSettings | None = None) -> None:
        """Start with everything unknown."""
        super().__init__(description, settings)
        self._driven = np.zeros(self._odds.shape, np.bool_)
        self._touched = np.zeros(self._odds.shape, np.bool_)
        self._tick = 0

    def drive(self, map_from_robot: Pose2) -> None:
        """Enter that the footprint is here: it is free, whatever was touched here before."""
        row, column = self.cells(np.array([map_from_robot.x, map_from_robot.y])).tolist()
        offsets = self._disc(self._description.radius + 0.5 * self._settings.cell)
        # From the middle of the cell: on its border rounding would leave gaps.
        here = self.cells(self.centre((row, column)) + offsets)
        rows, columns = here[:, 0], here[:, 1]
        self._odds[rows, columns], self._touched[rows, columns] = -MOST, False
        self._driven[row, column] = True

    def see_node(self, node: Node) -> None:
        """Enter what a node's landmarks show."""
        points, pose = node.points_in_robot, node.map_from_robot.mean
        known = np.isfinite(points).all(axis=1)
        points, sigmas = points[known], node.landmarks.depth_sigmas[known].astype(np.float64)
        origin = np.array([node.camera.mount_forward, 0.0])
        offsets = points[:, :2] - origin
        bearings, ranges = np.arctan2(offsets[:, 1], offsets[:, 0]), np.hypot(*offsets.T)
        edges, free = free_sectors(
            bearings, ranges - SIGMAS * sigmas, points[:, 2], node.camera.mount_height, self._settings.cell
        )
        if len(free):
            eye = pose.apply(origin[None])[0]
            around = self._disc(REACH)
            cells = self.cells(eye + around)
            off = np.angle(np.exp(1j * (np.arctan2(around[:, 1], around[:, 0]) - pose.heading)))
            sector = np.searchsorted(edges, off, side="right") - 1
            inside = (sector >= 0) & (sector < len(free))
            inside[inside] = np.hypot(*around[inside].T) < free[sector[inside]]
            seen = cells[inside]
            self._odds[seen[:, 0], seen[:, 1]] -= MISS
        self.see_points(pose, points, sigmas, node.camera.mount_height)

    def see_landmarks(self, map_from_robot: Pose2, landmarks: LandmarkEstimates) -> None:
        """Enter what is near by the mapping filter, now and then: it knows it before there is a node."""
        self._tick += 1
        near = np.isfinite(landmarks.depths) & (landmarks.depths < NEAR)
        if self._tick % EVERY == 0 and near.any():
            points, sigmas = landmarks.points_in_robot[near], landmarks.depth_sigmas[near]
            self.see_points(map_from_robot, points, sigmas, self._description.camera.mount_height)

    def see_points(self, map_from_robot: Pose2, points: Array, sigmas: Array, height: float) -> None:
        """Enter where landmarks are whose places are known well: something is there.

        Args:
            map_from_robot: pose.
            points: (N, 3) m, in robot.
            sigmas: (N,) m, of their distances.
            height: of the camera, m.
        """
        distance = np.hypot(points[:, 0], points[:, 1])
        solid = (points[:, 2] > FLOOR) & (points[:, 2] < OVERHANG * height)
        solid &= (sigmas < SURE) & (distance < REACH)
        numbers = self._numbers(map_from_robot.apply(points[solid, :2]))
        self._odds.flat[numbers] += HIT + MISS
        self._odds.flat[numbers[self._driven.flat[numbers]]] = -MOST
        np.clip(self._odds, -MOST, MOST, out=self._odds)

    def touch(self, map_from_robot: Pose2, direction: float) -> None:
        """Enter that the footprint touched something: it stays until the robot drives there.

        Args:
            map_from_robot: pose.
            direction: in which it drove, rad in robot: 0 ahead, pi behind.
        """
        angles = map_from_robot.heading + direction + np.linspace(-WIDTH, WIDTH, 7)
        reach = self._description.radius + self._settings.cell
        ends = np.array([map_from_robot.x, map_from_robot.y]) + reach * np.stack(
            [np.cos(angles), np.sin(angles)], axis=1
        )
        cells = self.cells(ends)
        self._touched[cells[:, 0], cells[:, 1]] = True

    def readings(self, map_from_robot: Pose2) -> Array:
        """What rangers along `BEARINGS` would read, but ahead and behind no further than the robot dares.

        Returns:
            (K,) m from the robot's edge.
        """
        along = np.arange(0.0, REACH, 0.5 * self._settings.cell)
        angles = map_from_robot.heading + np.array(BEARINGS)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        rays = (self._description.radius + along)[None, :, None] * directions[:, None]
        cells = self.cells(np.array([map_from_robot.x, map_from_robot.y]) + rays)
        at = cells[..., 0], cells[..., 1]
        readings = _first((self._odds[at] > DECIDED) | self._touched[at], along)
        for direction, beyond in ((0.0, DARED), (math.pi, SLACK)):
            beam = BEARINGS.index(direction)
            readings[beam] = min(readings[beam], self.known_ahead(map_from_robot, direction, REACH) + beyond)
        return readings

    def known_ahead(self, map_from_robot: Pose2, direction: float, reach: float) -> float:
        """How far the footprint may move straight on over floor that is known to be free, m.

        Args:
            map_from_robot: pose.
            direction: rad in robot: 0 ahead, pi behind.
            reach: largest result, m.
        """
        along = np.arange(0.0, reach, 0.5 * self._settings.cell)
        angle = map_from_robot.heading + direction
        fan = angle + np.linspace(-0.5 * math.pi, 0.5 * math.pi, 9)
        rim = self._description.radius * np.stack([np.cos(fan), np.sin(fan)], axis=1)
        start = np.array([map_from_robot.x, map_from_robot.y])
        way = along[:, None] * np.array([math.cos(angle), math.sin(angle)])
        cells = self.cells(start + way[:, None] + rim)
        at = cells[..., 0], cells[..., 1]
        known = ((self._odds[at] < -DECIDED) & ~self._touched[at]).all(axis=1)
        return float(_first(np.logical_not(known)[None], along, reach)[0])

    def room(self) -> Array:
        """The distance from each cell to the nearest thing seen or touched, m."""
        return self._distance(self._occupied)

    def drivable(self, unknown: bool = False) -> NDArray[np.bool_]:
        """Cells where the robot was, or where all of the footprint is on free floor, with clearance."""
        if unknown:
            return super().drivable(unknown)
        # The nearest point of a cell that is not free is up to half a diagonal nearer than its middle.
        needed = self._description.radius + math.sqrt(0.5) * self._settings.cell
        fits = self._distance(~self._free) >= needed
        return np.asarray((fits & (self.room() >= self._enough)) | (self._driven & self._free))

    def open_border(self, start: Array, reach: float) -> float:
        """Share of the border of the floor that it can reach behind which nothing is known.

        Args:
            start: (2,) m in map, where the robot is.
            reach: longest way, m.
        """
        reached = np.zeros(self._odds.shape, np.uint8)
        ways = self.ways(start, reach)
        reached[ways.cells[:, 0], ways.cells[:, 1]] = 1
        side = 2 * math.ceil((self._description.radius + self._settings.cell) / self._settings.cell) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        border = (cv2.dilate(reached, disc) > 0) & ~self._free
        return float((border & ~self._occupied).sum() / max(border.sum(), 1))

    @property
    def _occupied(self) -> NDArray[np.bool_]:
        return np.asarray((self._odds > DECIDED) | self._touched)

    @property
    def _free(self) -> NDArray[np.bool_]:
        return np.asarray((self._odds < -DECIDED) & ~self._touched)

    def _distance(self, cells: NDArray[np.bool_]) -> Array:
        """The distance from each cell to the nearest of some cells, m."""
        return np.asarray(
            cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, 5) * self._settings.cell
        )

    def _disc(self, radius: float) -> Array:
        """(N, 2) m, one offset a cell within a radius."""
        line = np.arange(
            -math.ceil(radius / self._settings.cell), math.ceil(radius / self._settings.cell) + 1
        )
        offsets = self._settings.cell * np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return np.asarray(offsets[np.hypot(*offsets.T) <= radius], np.float64)


def free_sectors(
    bearings: Array, ranges: Array, heights: Array, camera_height: float, margin: float
) -> tuple[Array, Array]:
    """Up to where the floor is free in each direction of a view, by its landmarks.

    Args:
        bearings: (N,) rad from the camera.
        ranges: (N,) m along the floor from the camera.
        heights: (N,) m above the floor.
        camera_height: m.
        margin: m, kept to the nearest landmark.

    Returns:
        (M + 1,) rad ascending, borders of the sectors, and (M,) m, how far each is free.
    """
    relevant = (heights < OVERHANG * camera_height) & (ranges > 0.0)
    bearings, ranges, heights = bearings[relevant], ranges[relevant], heights[relevant]
    bins = np.floor(bearings / BIN).astype(np.int64)
    centres: list[float] = []
    limits: list[float] = []
    for number in np.unique(bins):
        here = bins == number
        solid, passed = here & (heights > FLOOR), here & (heights <= camera_height)
        if passed.any():
            # What stands in the way, or else the furthest floor that is seen.
            limit = ranges[solid].min() if solid.any() else ranges[passed].max()
            centres.append((number + 0.5) * BIN)
            limits.append(min(float(limit) - margin, REACH))
    if len(centres) < 2:
        return np.zeros(0), np.zeros(0)
    edges, ends = np.array(centres), np.array(limits)
    free = np.minimum(np.minimum(ends[:-1], ends[1:]), GAP / np.diff(edges))
    return edges, np.maximum(free, 0.0)


def _first(hits: NDArray[np.bool_], along: Array, none: float = REACH) -> Array:
    """(K,) m, where along each row (of (K, N) cells) the first hit is; `none` without any."""
    return np.where(hits.any(axis=1), along[hits.argmax(axis=1)], none)
