"""Landmarks by what they look like from a place: two slopes, and an inverse depth that only a way tells.

For the robot at (x, y, h) of the place, its camera m_r ahead of the axle and the place's camera m_p, the
vector from the robot's camera to a landmark (1, a, b) / r along the place's ray is, times r,
    A = 1 - r (x + m_r cos h - m_p),  B = a - r (y + m_r sin h),
    X = A cos h + B sin h,  Y = -A sin h + B cos h,  Z = b + r dh,
and the image shows the slopes Y / X and Z / X. At r = 0, infinitely far away, only the heading is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.homing.keyframes import Keyframes
from hybridmap.camera import Camera
from hybridmap.pose import Array, Pose2, PoseGaussian

NEAREST = 0.02
"""Depths, as a share of that at the place, below which a landmark is not believed to be ahead."""

USUAL = 0.1
"""Inverse depth before anything is seen, as a share of its standard deviation."""


@dataclass(frozen=True, eq=False)
class Rays:
    """N landmarks by what they look like from the place.

    Attributes:
        values: (N, 3) slopes a and b at the place, and inverse depth r, 1/m.
        seen: (N, 2) slopes as the place's image shows them.
        sigmas: (3,) standard deviations before the way: of a, b and r.
        inverse_depth_sigmas: (N,) of r now, 1/m.
        mounts: how far the cameras stand ahead of the axle: the place's and the robot's, m.
        rise: how much higher the place's camera stands, m.
        height: of the place's camera, m.
    """

    values: Array
    seen: Array
    sigmas: Array
    inverse_depth_sigmas: Array
    mounts: tuple[float, float]
    rise: float
    height: float

    @property
    def off(self) -> Array:
        """(N, 3) how far the landmarks are from what was believed of them before the way."""
        return np.column_stack([self.values[:, :2] - self.seen, self.values[:, 2] - USUAL * self.sigmas[2]])

    @staticmethod
    def of(
        place: Camera, pixels: NDArray[np.floating], sigma_px: float, nearness: float, robot: Camera
    ) -> Rays:
        """Pixels (N, 2) of the place's camera, nothing known of their depth but that it is seldom small."""
        slopes = (np.array([place.cx, place.cy]) - np.asarray(pixels, dtype=np.float64)) / np.array(
            [place.fx, place.fy]
        )
        n = len(slopes)
        return Rays(
            np.column_stack([slopes, np.full(n, USUAL * nearness)]),
            slopes,
            np.array([sigma_px / place.fx, sigma_px / place.fy, nearness]),
            np.full(n, nearness),
            (place.mount_forward, robot.mount_forward),
            place.mount_height - robot.mount_height,
            place.mount_height,
        )

    def offsets(self, frames: Keyframes) -> tuple[Array, Array, Array, Array]:
        """(K, 1) each: cos and sin of the headings, and where the robot's camera is from the place's, m."""
        x, y, heading = frames.postures.T[:, :, None]
        c, s = np.cos(heading), np.sin(heading)
        return c, s, x + self.mounts[1] * c - self.mounts[0], y + self.mounts[1] * s

    def moved(self, change: Array, frames: Keyframes) -> Rays:
        """The slopes with their part of (N, 3) added, the inverse depths found anew for moved postures.

        A step along the open scale makes all ways longer by the share k and has to divide r by 1 + k, of
        which its linear part says -k r: only short steps would be any good. Depths that are found anew after
        each step (Jeong et al. 2012) let it go all the way.
        """
        values = self.values.copy()
        values[:, :2] += change[:, :2]
        moved = replace(self, values=values)
        return moved.triangulated(frames).triangulated(frames)

    def triangulated(self, frames: Keyframes) -> Rays:
        """Inverse depths by least squares on all that was seen, slopes and postures as they are."""
        a, b, r = self.values.T
        c, s, tx, ty = self.offsets(frames)
        u, v = np.nan_to_num(frames.slopes[..., 0]), np.nan_to_num(frames.slopes[..., 1])
        ahead, left = c + s * a, -s + c * a
        by_ahead, by_left = -(c * tx + s * ty), s * tx - c * ty
        w1, y1 = by_left - u * by_ahead, u * ahead - left
        w2, y2 = self.rise - v * by_ahead, v * ahead - b
        depth = np.maximum(ahead + r * by_ahead, NEAREST)
        weight = np.where(np.isfinite(frames.slopes[..., 0]), (self.sigmas[0] * depth) ** -2, 0.0)
        prior = self.sigmas[2]
        square = (weight * (w1 * w1 + w2 * w2)).sum(axis=0) + prior**-2
        solved = ((weight * (w1 * y1 + w2 * y2)).sum(axis=0) + USUAL / prior) / square
        values = self.values.copy()
        values[:, 2] = np.maximum(solved, 0.0)
        return replace(self, values=values)

    def points(self, known: NDArray[np.bool_], farthest: float) -> Array:
        """(N, 3) m, in the place's robot frame; NaN for those not known."""
        depth = 1.0 / np.maximum(self.values[:, 2], 1.0 / farthest)
        points = np.column_stack(
            [depth + self.mounts[0], self.values[:, 0] * depth, self.height + self.values[:, 1] * depth]
        )
        points[~known] = np.nan
        return points


def rescaled(frames: Keyframes, rays: Rays, prior: PoseGaussian) -> tuple[Keyframes, Rays]:
    """The same shape, as large as wheels and prior say: pixels have no say in that."""
    before, after = frames.postures[:-1], frames.postures[1:]
    ways = after[:, :2] - before[:, :2]
    wheels = [
        Pose2(heading=float(b[2])).rotation @ s.mean.vector[:2]
        for b, s in zip(before, frames.steps, strict=True)
    ]
    weights = [2.0 / float(np.trace(s.covariance[:2, :2])) for s in frames.steps]
    ways = np.vstack([ways, frames.postures[:1, :2]])
    wanted = np.array([*wheels, prior.mean.vector[:2]])
    weight = np.array([*weights, 2.0 / float(np.trace(prior.covariance[:2, :2]))])
    below = float(weight @ (ways**2).sum(axis=1))
    scale = float(weight @ (ways * wanted).sum(axis=1)) / below if below > 0.0 else 1.0
    scale = min(max(scale, 0.2), 5.0)
    postures, values = frames.postures.copy(), rays.values.copy()
    postures[:, :2] *= scale
    values[:, 2] /= scale
    return replace(frames, postures=postures), replace(rays, values=values)
