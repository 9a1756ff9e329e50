"""What the tracks of one image pair say of the camera's motion: a Gaussian of six numbers.

Each track gives two equations. Its depth is unknown and is eliminated: along the line on which it may lie it
counts only as far as depths are known beforehand, so the rest is the epipolar constraint; where the camera
only turns, both equations count. A sensor is reduced to its motion in the same manner by Censi, Franchi,
Marchionni and Oriolo (Simultaneous calibration of odometry and sensor parameters, 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import median
from mapweave.agent.calibration.camera_motions import CameraMotions
from mapweave.hybridmap.pose import Array

CAUCHY = 2.3849
"""Sigmas of a residual at which its weight has halved: 95 % efficiency on Gaussian noise (Huber 1981)."""
FLOOR_STEEPNESS = 0.12
"""Rays less below the horizon than this, rad, meet the floor too far off to tell it from other things."""
LEAST_FLOOR_SHARE = 0.08
"""Sigma of a floor point's depth as a share of it; with less parallax it shows nothing."""
FARTHEST_FLOOR = 20.0
"""Points below the horizon are no further off than so many times the floor there."""
FREE_DEPTH = 3.0
"""Spreads of the scene's inverse depths within which a track's is free. One spread draws near floor and far
walls together, which shows as pitch and as a way 0.7 % too long (rendered room); three do not. What is
linearised about has one spread all the same: near the focus of expansion depths are noise, and noise in a
Jacobian passes for information."""
NO_PRIOR = 1e6
"""Spread of inverse depths of which nothing is known, 1/m."""
STEPS = 2
"""Of Gauss and Newton, from the motion by the wheels to that which a pair is linearised about."""


@dataclass(frozen=True, eq=False)
class FloorMatches:
    """Points that may lie on the floor, in both images of a pair.

    Attributes:
        before: (K, 2) normalised coordinates in the first image.
        after: (K, 2) the same in the second.
        sigmas: (K,) standard deviations of them along the line on which they can lie.
    """

    before: Array
    after: Array
    sigmas: Array

    @classmethod
    def none(cls) -> FloorMatches:
        """No points."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Points that were followed from one image to another.

    Attributes:
        first_s: stamp of the first image, s.
        last_s: stamp of the second, s.
        before: (N, 2) normalised coordinates of the ideal image in the first image: (pixel - c) / f.
        after: (N, 2) the same in the second.
        floor: points besides that tell the floor and nothing else.
    """

    first_s: float
    last_s: float
    before: Array
    after: Array
    floor: FloorMatches = field(default_factory=FloorMatches.none)

    @cached_property
    def rows(self) -> tuple[Array, Array, Array]:
        """What a reduction begins with: (3, N) rays of the first image, (2, N) `after`, (6, N) `_field`."""
        return _rays(self.before), np.ascontiguousarray(self.after.T), _field(self.before)

    @cached_property
    def floor_rows(self) -> tuple[Array, Array]:
        """Tracks, then the floor: (3, N + K) rays, (2, N + K) coordinates in the second image."""
        before = np.concatenate([self.before, self.floor.before])
        return _rays(before), np.concatenate([self.after, self.floor.after]).T.copy()


@dataclass(frozen=True, eq=False)
class FloorPoints:
    """Points below the horizon: most of what is seen there is floor.

    Attributes:
        points: (K, 3) m in the first camera.
        sigmas: (K,) standard deviations of the logarithms of their depths, by the matches.
    """

    points: Array
    sigmas: Array


@dataclass(frozen=True, eq=False)
class PairInformation:
    """A pair reduced: -log p = 1/2 s' A s - b' s for a step s = `motion.since(at)`.

    Attributes:
        at: one motion, about which it is linearised.
        matrix: (6, 6) A.
        vector: (6,) b.
        tracks: how many agree with each other.
        inverse_depths: median and standard deviation, 1/m.
        scatter: standard deviation of what is left across the lines of unknown depth, by its median.
        floor: at the motion `at`.
    """

    at: CameraMotions
    matrix: Array
    vector: Array
    tracks: int
    inverse_depths: tuple[float, float]
    scatter: float
    floor: FloorPoints


def reduce_pair(
    pair: ImagePair,
    predicted: CameraMotions,
    noise: Array,
    sigma: float,
    depth: tuple[float, float],
    floor_sigma: float,
) -> PairInformation:
    """Reduce a pair about the motion that tracks and wheels together make most likely.

    Args:
        pair: the tracks.
        predicted: one motion, by the wheels.
        noise: (6, 6) covariance of the wheels' errors, as a step.
        sigma: standard deviation of a track, in normalised coordinates.
        depth: mean and standard deviation of inverse depths beforehand, 1/m.
        floor_sigma: of a track on the floor, which has less texture than what stands on it.
    """
    rays, after, shapes = pair.rows
    prior = np.linalg.inv(noise)
    at = predicted
    for k in range(STEPS):
        seen = _linearised(rays, after, at, sigma, depth, shapes)
        pull = seen.vector - prior @ at.since(predicted) if k else seen.vector
        at = at.stepped(np.asarray(np.linalg.solve(seen.matrix + prior, pull), np.float64))
    seen = _linearised(rays, after, at, sigma, depth, shapes)
    depths = seen.inverse_depths[seen.agreeing]
    typical = (median(depths), float(depths.std())) if len(depths) > 5 else depth
    floor = floor_points(pair, at, floor_sigma)
    return PairInformation(
        at, seen.matrix, seen.vector, len(depths), typical, 1.4826 * median(seen.across), floor
    )


class _Linearised(NamedTuple):
    """Tracks linearised about a motion.

    Attributes:
        matrix: (6, 6) as of `PairInformation`.
        vector: (6,) likewise.
        inverse_depths: (N,) 1/m.
        agreeing: (N,) whether a track agrees with the motion.
        across: (N,) how far tracks are from the lines on which their points can lie.
    """

    matrix: Array
    vector: Array
    inverse_depths: Array
    agreeing: NDArray[np.bool_]
    across: Array


def _linearised(
    rays: Array, after: Array, at: CameraMotions, sigma: float, depth: tuple[float, float], shapes: Array
) -> _Linearised:
    """Linearise about a motion. A row holds one number of all tracks: a few long rows are computed fastest.

    Args:
        rays: (3, N) as `_rays`, of the first image.
        after: (2, N) normalised coordinates in the second.
        at: one motion.
        sigma: standard deviation of a track.
        depth: mean and standard deviation of inverse depths beforehand, 1/m.
        shapes: (6, N) as `_field`.
    """
    mean, spread = depth
    translation = at.translation
    turned = at.rotation @ rays
    rho = _inverse_depths(turned, translation, after, sigma, depth)
    y = turned + translation[:, None] * rho
    good = y[2] > 0.05
    z = np.where(good, y[2], 1.0)
    seen = y[:2] / z
    slope = _projected(translation, seen, z)
    square = slope[0] * slope[0] + slope[1] * slope[1]
    length = np.maximum(np.sqrt(square), 1e-12)
    off = mean - rho
    # By the field of depths, by the step, and the residual.
    columns = np.empty((len(shapes) + 7, 2, rays.shape[1]))
    np.multiply(shapes[:, None], slope, out=columns[: len(shapes)])
    _derive(seen, z, rho, slope / length, off, columns[len(shapes) : -1])
    jacobian, residual = columns[:-1], columns[-1]
    np.subtract(after - seen, slope * off, out=residual)
    # (sigma^2 I + spread^2 g g')^-1 by Sherman and Morrison.
    gain = 1.0 / ((sigma / spread) ** 2 + square)
    along = slope[0] * residual[0] + slope[1] * residual[1]
    squares = residual[0] * residual[0] + residual[1] * residual[1]
    chi2 = (squares - gain * along * along) / sigma**2
    weight = good / (1.0 + chi2 / CAUCHY**2) / sigma**2
    inside = jacobian[:, 0] * slope[0] + jacobian[:, 1] * slope[1]
    left = weight * (jacobian - inside[:, None] * (gain * slope))
    normal = left.reshape(len(left), -1) @ columns.reshape(len(columns), -1).T
    normal = _without_field(normal, FREE_DEPTH * spread)
    across = np.abs(residual[0] * slope[1] - residual[1] * slope[0]) / length
    return _Linearised(normal[:, :6], normal[:, 6], rho, good & (chi2 < 9.0), across)


def with_floor(information: PairInformation, pair: ImagePair, floor_sigma: float) -> PairInformation:
    """What a reduced pair says with the points of its floor."""
    return replace(information, floor=floor_points(pair, information.at, floor_sigma))


def floor_points(pair: ImagePair, at: CameraMotions, track_sigma: float) -> FloorPoints:
    """Tracks and matches below the horizon, as points.

    Args:
        pair: the points.
        at: one motion.
        track_sigma: standard deviation of a track.
    """
    rays, after = pair.floor_rows
    floor_depth = at.floor @ rays
    steepness = floor_depth / math.sqrt(at.floor @ at.floor)
    steep = np.flatnonzero(steepness > FLOOR_STEEPNESS)
    floor_depth = floor_depth[steep]
    rays, after = rays.take(steep, axis=1), after.take(steep, axis=1)
    sigma = np.concatenate([np.full(len(pair.before), track_sigma), pair.floor.sigmas])[steep]
    turned = at.rotation @ rays
    # What is typical in this scene must not draw the floor to it.
    inverse_depth = _inverse_depths(turned, at.translation, after, track_sigma, (0.0, NO_PRIOR))
    y = turned + at.translation[:, None] * floor_depth
    z = np.maximum(y[2], 0.05)
    slope = _projected(at.translation, y[:2] / z, z)
    parallax = np.sqrt(slope[0] * slope[0] + slope[1] * slope[1]) * floor_depth
    precise = sigma < LEAST_FLOOR_SHARE * parallax
    nearness = np.maximum(inverse_depth[precise], floor_depth[precise] / FARTHEST_FLOOR)
    return FloorPoints((rays[:, precise] / nearness).T, sigma[precise] / parallax[precise])


def _rays(coordinates: Array) -> Array:
    """(3, N) points (u, v, 1), of (N, 2) normalised coordinates."""
    rays = np.ones((3, len(coordinates)))
    rays[:2] = coordinates.T
    return rays


def _projected(direction: Array, seen: Array, z: Array) -> Array:
    """(2, N) how points seen at (2, N), at depths (N,), move in the image along a direction (3,)."""
    moved: Array = (direction[:2, None] - seen * direction[2]) / z
    return moved


def _inverse_depths(
    turned: Array, translation: Array, after: Array, sigma: float, depth: tuple[float, float]
) -> Array:
    """(N,) most likely inverse depths, not below zero: two equations linear in each, and a prior.

    From y = a + rho t: (a_z + rho t_z) (u, v) = (a_x + rho t_x, a_y + rho t_y).

    Args:
        turned: (3, N) a.
        translation: (3,) t, m.
        after: (2, N) u and v.
        sigma: standard deviation of a track.
        depth: mean and standard deviation beforehand, 1/m.
    """
    mean, spread = depth
    slope = translation[:2, None] - after * translation[2]
    constant = after * turned[2] - turned[:2]
    scale = np.maximum(turned[2], 0.05) ** 2 * sigma**2
    information = (slope[0] * slope[0] + slope[1] * slope[1]) / scale + 1.0 / spread**2
    measured = (slope[0] * constant[0] + slope[1] * constant[1]) / scale
    best: Array = (measured + mean / spread**2) / information
    return np.maximum(best, 0.0)


def _derive(seen: Array, z: Array, rho: Array, along: Array, off: Array, out: Array) -> None:
    """Derivatives of the predicted coordinates with respect to a step.

    A depth is estimated from the very residual along the line on which the point may lie. So along that line
    the depth known beforehand takes its place: a product of one noise with itself has a mean.

    Args:
        seen: (2, N) predicted coordinates.
        z: (N,) depths in the second camera over those in the first.
        rho: (N,) inverse depths, 1/m.
        along: (2, N) direction of each point's line.
        off: (N,) inverse depth known beforehand less that, 1/m.
        out: (6, 2, N), is written.
    """
    u, v = seen
    # With (rho I + off a a') / z a shift of the image becomes what a shift of the camera does.
    own, lent = rho / z, (off / z) * along
    np.multiply(lent[0], along, out=out[0])
    np.multiply(lent[1], along, out=out[1])
    out[0, 0] += own
    out[1, 1] += own
    out[2] = -(out[0] * u + out[1] * v)
    # omega x y, projected; y / z = (u, v, 1).
    both = u * v
    out[3, 0], out[3, 1] = -both, -1.0 - v * v
    out[4, 0], out[4, 1] = 1.0 + u * u, both
    out[5, 0], out[5, 1] = -v, u


def _field(before: Array) -> Array:
    """(6, N) shapes of which the inverse depths of a scene are made: a polynomial over the image."""
    u, v = (before / np.abs(before).max(axis=0)).T
    return np.stack([np.ones(len(before)), u, v, u * u, u * v, v * v])


def _without_field(normal: Array, spread: float) -> Array:
    """(6, 7) normal equations of a step without those of the field of depths, which is eliminated.

    What is assumed of depths must tell nothing of the way.

    Args:
        normal: (12, 13) of field and step, with their right side.
        spread: of the field, 1/m.
    """
    inner = normal[:6, :6] + np.eye(6) / spread**2
    return np.asarray(normal[6:, 6:] - normal[6:, :6] @ np.linalg.solve(inner, normal[:6, 6:]))
