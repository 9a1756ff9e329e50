"""Exact planar motion: of the pose, and of landmarks in the moving camera's inverse-depth coordinates.

A landmark is (a, b, w) = (p1/p3, p2/p3, 1/p3) with p1 right, p2 down and p3 forward of the optical centre
of the moving camera, m. One step of the wheels, u1 forward and u2 counter-clockwise, carries the optical
centre by (tx forward, ty left) and turns it by u2:

    tx = u1 cos(u2/2) + m (cos u2 - 1),   ty = u1 sin(u2/2) + m sin u2

with m the way of the optical centre ahead of the axle. With p1' and p3' of docs/method.md divided by p3 one
gets, all in closed form and without a pole at w = 0 (a landmark at infinity),

    D  = cos u2 (1 - tx w) - sin u2 (a + ty w)
    a' = (sin u2 (1 - tx w) + cos u2 (a + ty w)) / D,   b' = b / D,   w' = w / D.
"""

import math
from dataclasses import dataclass

import numpy as np

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array

STANDS = 1e-4
"""A wheel's way below this is none, m."""
WIDEST_SLOPE = 4.0
"""Landmarks further aside than this |a| are let go, or cannot be anchored at a node: 76 degrees off the axis.
Chosen: a' grows without bound as D goes to 0 (above), so the linearisation fails before that."""
WHEEL_FLOOR = 1e-5
"""Standard deviation of a wheel's way in a step that has none, m. It keeps the covariance of a standing
robot's step invertible, and is a tenth of `STANDS`. An encoder that is silent while the robot moves is
refuted by its first image (docs/decisions/ekf-parametrisation.md)."""


@dataclass(frozen=True, slots=True)
class WheelNoise:
    """How uncertain the wheels' ways are.

    Attributes:
        axle: distance between the wheels L, m.
        share: standard deviation of a wheel's way as a share of the way: sigma of the paper.
    """

    axle: float
    share: float

    def root(self, odometry: Odometry) -> Array:
        """(2, 2) root R of the covariance R R^T of (u1 m, u2 rad) of one step, one column a wheel."""
        right, left = self.ways(odometry)
        return self._root(
            math.hypot(self.share * right, WHEEL_FLOOR), math.hypot(self.share * left, WHEEL_FLOOR)
        )

    def refuted_root(self, odometry: Odometry, factor: float, lost: float) -> Array:
        """The noise of wheels that cannot be right: more for a way, unbounded for a wheel that reports none.

        Args:
            odometry: the step.
            factor: by which the wheels err more than they should.
            lost: standard deviation of a wheel's way if its encoder reports none, m.

        Returns:
            (2, 2) root of the covariance of forward, m, and turn, rad.
        """
        sigmas = [
            factor * self.share * abs(way) if abs(way) > STANDS else lost for way in self.ways(odometry)
        ]
        return self._root(*sigmas)

    def ways(self, odometry: Odometry) -> tuple[float, float]:
        """Ways of the right and the left wheel, m."""
        half = 0.5 * self.axle * odometry.turn
        return odometry.forward + half, odometry.forward - half

    def _root(self, right: float, left: float) -> Array:
        return np.array([[0.5 * right, 0.5 * left], [right / self.axle, -left / self.axle]])


def move_pose(pose_vector: Array, odometry: Odometry, aside: float = 0.0) -> tuple[Array, Array, Array]:
    """Move a pose by one step of the wheels.

    Args:
        pose_vector: (3,) [x m, y m, heading rad] in any fixed frame.
        odometry: the step.
        aside: u3, how far the robot slips to the left of its way, m.

    Returns:
        The pose after, (3,); its Jacobians by the pose before, (3, 3), and by (u1, u2, u3), (3, 3).
    """
    u1, u2 = odometry.forward, odometry.turn
    c, s = math.cos(pose_vector[2] + 0.5 * u2), math.sin(pose_vector[2] + 0.5 * u2)
    x, y = u1 * c - aside * s, u1 * s + aside * c
    after = pose_vector + np.array([x, y, u2])
    by_pose = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    by_input = np.array([[c, -0.5 * y, -s], [s, 0.5 * x, c], [0.0, 1.0, 0.0]])
    return after, by_pose, by_input


def transform_rays(
    rays: Array, odometry: Odometry, mount_forward: float, aside: float = 0.0
) -> tuple[Array, Array]:
    """Transform landmarks into the camera frame after one step of the wheels.

    Args:
        rays: (N, 3) [a, b, w 1/m] in the camera before the step.
        odometry: the step.
        mount_forward: of the optical centre ahead of the axle, m.
        aside: u3, how far the robot slips to the left of its way, m.

    Returns:
        (N, 3) rays in the camera after the step; (N,) D, depth after over depth before, not positive for
        landmarks now behind the camera, whose rays mean nothing.
    """
    c, s = math.cos(odometry.turn), math.sin(odometry.turn)
    tx, ty = _camera_way(odometry, mount_forward, aside)
    a, w = rays[:, 0], rays[:, 2]
    ahead, right = 1.0 - tx * w, a + ty * w
    scale = c * ahead - s * right
    after = rays.copy()
    after[:, 0] = s * ahead + c * right
    after /= np.maximum(scale, 1e-9)[:, None]
    return after, scale


@dataclass(frozen=True, eq=False, slots=True)
class RayMotion:
    """Landmarks after a step of the wheels, and its derivatives.

    Attributes:
        rays: (N, 3) [a, b, w 1/m] in the camera after the step.
        by_ray: (N, 3, 3) Jacobian by the landmark before.
        by_input: (N, 3, 3) Jacobian by (u1, u2, u3).
        scale: (N,) D, depth after over depth before; where it is not positive the other figures mean nothing.
    """

    rays: Array
    by_ray: Array
    by_input: Array
    scale: Array


def move_rays(rays: Array, odometry: Odometry, mount_forward: float, aside: float = 0.0) -> RayMotion:
    """See landmarks (n, 3) after one step of the wheels, as `transform_rays`, with the Jacobians."""
    after, scale = transform_rays(rays, odometry, mount_forward, aside)
    u1, u2, m = odometry.forward, odometry.turn, mount_forward
    c, s, ch, sh = math.cos(u2), math.sin(u2), math.cos(0.5 * u2), math.sin(0.5 * u2)
    along, across = u1 * ch - aside * sh, u1 * sh + aside * ch
    tx, ty = _camera_way(odometry, mount_forward, aside)
    # Derivatives of the camera's way by (u1, u2, u3).
    tx_by = np.array([ch, -0.5 * across - m * s, -sh])
    ty_by = np.array([sh, 0.5 * along + m * c, ch])
    w, safe = rays[:, 2:], np.maximum(scale, 1e-9)[:, None, None]
    # Each new coordinate is a quotient n / D, so its derivative is (dn - (n / D) dD) / D.
    by_ray = after[:, :, None] * np.array([s, 0.0, c * tx + s * ty])
    by_ray += np.array([[c, 0.0, c * ty - s * tx], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    by_ray /= safe
    scale_by = w * (-c * tx_by - s * ty_by)
    scale_by[:, 1] -= after[:, 0] * scale
    by_input = after[:, :, None] * -scale_by[:, None, :]
    by_input[:, 0] += w * (c * ty_by - s * tx_by)
    by_input[:, 0, 1] += scale
    by_input /= safe
    return RayMotion(after, by_ray, by_input, scale)


def propagate(covariance: Array, by_state: Array, by_input: Array, input_root: Array) -> Array:
    """A P A^T + B S B^T of a motion whose A is block diagonal, symmetric to the last bit.

    Args:
        covariance: (3 + 3n, 3 + 3n) P before, of [pose, (a, b, w) of each landmark].
        by_state: (1 + n, 3, 3) blocks of A: of the pose, then of each landmark.
        by_input: (3 + 3n, 3) B, by (u1, u2, u3).
        input_root: (3, 3) root of the covariance S of these.
    """
    blocks, size = len(by_state), len(covariance)
    # Blocks times rows, never the dense product; P is symmetric, so that (A P)^T = P A^T.
    half = (by_state @ covariance.reshape(blocks, 3, size)).reshape(size, size)
    moved = (by_state @ half.T.reshape(blocks, 3, size)).reshape(size, size)
    out: Array = moved + moved.T
    out *= 0.5
    root = by_input @ input_root
    # A product with its own transpose is symmetric to the last bit.
    out += root @ root.T
    return out


def _camera_way(odometry: Odometry, mount_forward: float, aside: float) -> tuple[float, float]:
    """(tx forward, ty left) m, of the optical centre in one step of the wheels."""
    u1, u2 = odometry.forward, odometry.turn
    ch, sh = math.cos(0.5 * u2), math.sin(0.5 * u2)
    tx = u1 * ch - aside * sh + mount_forward * (math.cos(u2) - 1.0)
    return tx, u1 * sh + aside * ch + mount_forward * math.sin(u2)
