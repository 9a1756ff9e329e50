"""Motions of the camera, as the wheels and the parameters of a drive predict them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from mapweave.agent.arrays import median
from mapweave.agent.drive_geometry import Parameter
from mapweave.hybridmap.pose import Array

SUBSTEPS = 8
"""Into which the wheels' way between two images is cut; over a second, chords of 0.1 s."""
_SHARES: Array = np.linspace(0.0, 1.0, SUBSTEPS + 1)


@dataclass(frozen=True, eq=False)
class WheelTrack:
    """What the wheels have counted, on their own clock.

    Attributes:
        stamps: (K,) s, ascending.
        way: (K,) m since the beginning, backwards negative.
        turn: (K,) rad since the beginning.
    """

    stamps: Array
    way: Array
    turn: Array

    def between(self, first: Array, last: Array) -> tuple[Array, Array]:
        """Ways (N, SUBSTEPS) m and turns (N, SUBSTEPS) rad in equal parts of (N,) intervals of time, s.

        The wheels go on as they did at the ends of what was counted: a delay reaches beyond it.
        """
        times = first[:, None] + (last - first)[:, None] * _SHARES
        # Plain interpolation halves the noise of a reading in its middle, and a fit of the delay goes there.
        ways, turns = np.diff(self._mean(times, median(self._steps)), axis=2)
        return ways, turns

    def smooth(self, seconds: float) -> WheelTrack:
        """The same averaged over a time about each reading."""
        return WheelTrack(self.stamps, *self._mean(self.stamps, seconds))

    def _covering(self, first: float, last: float) -> WheelTrack:
        """Itself, or its readings from one time, s, to another where these are few, as of a single pair."""
        begin, end = self.stamps.searchsorted([first, last], side="right").tolist()
        begin = max(min(begin - 1, len(self.stamps) - 2), 0)
        end = max(end + 1, begin + 2)
        if 2 * (end - begin) > len(self.stamps):
            return self
        return WheelTrack(self.stamps[begin:end], self.way[begin:end], self.turn[begin:end])

    @cached_property
    def _steps(self) -> Array:
        """(K - 1,) s, from each reading to the next."""
        return np.diff(self.stamps)

    @cached_property
    def _integrals(self) -> tuple[Array, Array, Array]:
        """Counted ways and turns, and their integrals, (2, K) each; its rate, (2, K - 1)."""
        counted, steps = np.stack([self.way, self.turn]), self._steps
        areas = np.zeros_like(counted)
        np.cumsum(0.5 * (counted[:, 1:] + counted[:, :-1]) * steps, axis=1, out=areas[:, 1:])
        return counted, areas, np.diff(counted) / steps

    def _mean(self, times: Array, width: float) -> Array:
        """(2, ...) way and turn, each averaged over a time, s, about each of (...) times."""
        part = self._covering(times.min() - 0.5 * width, times.max() + 0.5 * width)
        counted, areas, rates = part._integrals

        def integral(t: Array) -> Array:
            i = np.minimum(np.maximum(part.stamps.searchsorted(t, side="right") - 1, 0), len(part._steps) - 1)
            after = t - part.stamps[i]
            return np.asarray(areas[:, i] + counted[:, i] * after + 0.5 * rates[:, i] * after**2)

        ends = integral(np.stack([times + 0.5 * width, times - 0.5 * width]))
        return np.asarray((ends[:, 0] - ends[:, 1]) / width)


@dataclass(frozen=True, eq=False)
class CameraMotions:
    """Motions of a camera between pairs of images, and the floor as the first image's camera sees it.

    A point at depth z of the first camera, with normalised coordinates x = (u, v, 1), lies in the direction
    `rotation @ x + translation / z` of the second.

    Attributes:
        rotation: (N, 3, 3) `second_from_first`.
        translation: (N, 3) m.
        floor: (N, 3) 1/m; a point of the floor has the inverse depth floor . x.
    """

    rotation: Array
    translation: Array
    floor: Array

    def since(self, other: CameraMotions) -> Array:
        """(N, 6) small step from another motion to this: translation m, rotation rad.

        A step (tau, omega) turns y = R x + rho t into y + omega x y + rho tau.
        """
        apart = self.rotation @ np.swapaxes(other.rotation, -1, -2)
        entries = apart.reshape(*apart.shape[:-2], 9)
        sine = 0.5 * (entries.take(_POSITIVE, axis=-1) - entries.take(_NEGATIVE, axis=-1))
        size = np.sqrt((sine * sine).sum(axis=-1, keepdims=True))
        cosine = 0.5 * (entries[..., :1] + entries[..., 4:5] + entries[..., 8:] - 1.0)
        step = np.empty((*sine.shape[:-1], 6))
        step[..., :3] = self.translation - (apart @ other.translation[..., None])[..., 0]
        step[..., 3:] = sine * np.where(
            size > 1e-12, np.arctan2(size, cosine) / np.maximum(size, 1e-300), 1.0
        )
        return step

    def stepped(self, step: Array) -> CameraMotions:
        """These motions, each moved by a row of (N, 6) small steps; the inverse of `since`."""
        turn = rotations(step[..., 3:6])
        moved = (turn @ self.translation[..., None])[..., 0] + step[..., :3]
        return CameraMotions(turn @ self.rotation, moved, self.floor)

    def __getitem__(self, index: Any) -> CameraMotions:
        """Some of them."""
        return CameraMotions(self.rotation[index], self.translation[index], self.floor[index])


def rotations(vectors: Array) -> Array:
    """(..., 3, 3) rotations by (..., 3) rotation vectors, rad: Rodrigues' formula."""
    square = (vectors * vectors).sum(axis=-1)[..., None, None]
    angle = np.maximum(np.sqrt(square), 1e-20)
    a, b = np.sin(angle) / angle, 0.5 * (np.sin(0.5 * angle) / (0.5 * angle)) ** 2
    # The square of a skew matrix is v v' - |v|^2 I.
    out = b * (vectors[..., :, None] * vectors[..., None, :])
    out += (1.0 - b * square) * _IDENTITY
    turned = a[..., 0] * vectors
    for k, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        out[..., row, column] += turned[..., k]
        out[..., column, row] -= turned[..., k]
    return np.asarray(out)


_IDENTITY = np.eye(3)
_POSITIVE, _NEGATIVE = np.array([7, 2, 3]), np.array([5, 6, 1])
"""Entries of a skew matrix, row by row, that are x, y and z of its vector, and those that are negated."""

ROBOT_FROM_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Of a camera that looks straight ahead: x right, y down, z forward."""


@lru_cache(maxsize=16)
def robot_from_camera(heading: float, pitch: float, roll: float) -> Array:
    """(3, 3) rotation of the mount, angles in rad as in `DriveGeometry`; not to be written to."""
    about = np.array([[0.0, 0.0, heading], [0.0, pitch, 0.0], [roll, 0.0, 0.0]])
    z, y, x = rotations(about)
    mount = np.asarray(z @ y @ x @ ROBOT_FROM_LEVEL)
    mount.flags.writeable = False
    return mount


def predict(vector: Array, wheels: WheelTrack, first: Array, last: Array) -> CameraMotions:
    """Camera motions between images by the wheels, for one set of parameters.

    Args:
        vector: (10,) in the order of `Parameter`.
        wheels: what they counted.
        first: (N,) s, stamps of the first images.
        last: (N,) s, stamps of the second images.
    """
    return motions_over(vector, *counted(vector, wheels, first, last))


def counted(vector: Array, wheels: WheelTrack, first: Array, last: Array) -> tuple[Array, Array]:
    """Ways and turns of the wheels between images, as `WheelTrack.between`, their delay considered."""
    delay = vector[Parameter.DELAY]
    return wheels.between(first + delay, last + delay)


def motions_over(vector: Array, ways: Array, turns: Array) -> CameraMotions:
    """Camera motions over ways and turns that were reported.

    Args:
        vector: (10,) in the order of `Parameter`; its delay has been considered.
        ways: (N, SUBSTEPS) m.
        turns: (N, SUBSTEPS) rad.
    """
    p = Parameter
    ways = math.exp(vector[p.WHEEL_SCALE]) * ways
    turns = math.exp(vector[p.TURN_SCALE]) * turns + vector[p.DRIFT] * ways
    heading = np.cumsum(turns, axis=1)
    middle = heading - 0.5 * turns
    mount, centre = _robot_from_camera(vector)
    x, y = centre[0] - (ways * np.cos(middle)).sum(1), centre[1] - (ways * np.sin(middle)).sum(1)
    cosine, sine = np.cos(heading[:, -1]), np.sin(heading[:, -1])
    # The robot turns about the up of the camera: its rows of the mount stay, the others turn into each other.
    ahead, left, up = mount
    turning = ahead[:, None] * left
    turning = turning - turning.T
    standing = up[:, None] * up
    rotation = standing + cosine[:, None, None] * (_IDENTITY - standing) + sine[:, None, None] * turning
    moved_x, moved_y = cosine * x + sine * y - centre[0], cosine * y - sine * x - centre[1]
    translation = moved_x[:, None] * ahead + moved_y[:, None] * left
    floor = np.empty((len(ways), 3))
    floor[:] = -math.exp(-vector[p.HEIGHT]) * up
    return CameraMotions(rotation, translation, floor)


def slip_steps(vector: Array) -> Array:
    """(6, 3) how slip at the end of a motion changes the camera's, to first order.

    The robot moves besides by m ahead, m to the left and rad of turning: a column each, as the small steps of
    `CameraMotions.since`. A point p of the camera is M p + c of the robot; slip (d, theta) takes it to
    M p + c - d - theta z x (M p + c), which is p + omega x p + tau with omega = -theta M' z and
    tau = -M' (d + theta z x c). The motion itself does not matter.
    """
    mount, centre = _robot_from_camera(vector)
    moved = np.eye(3)
    moved[:, 2] = -centre[1], centre[0], 0.0
    turned = np.diag([0.0, 0.0, 1.0])
    return np.asarray(np.concatenate([-mount.T @ moved, -mount.T @ turned]))


def _robot_from_camera(vector: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and place (3,) m of the camera on the robot; its height is that of the floor."""
    p = Parameter
    numbers = vector.tolist()
    mount = robot_from_camera(numbers[p.HEADING], numbers[p.PITCH], numbers[p.ROLL])
    return mount, np.array([numbers[p.FORWARD], numbers[p.LEFT], 0.0])
