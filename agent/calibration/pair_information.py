"""What the tracks of one image pair say of the camera's motion: a Gaussian of six numbers.

Each track gives two equations. Its depth is unknown and is eliminated: along the line on which it may lie it
counts only as far as depths are known beforehand, so the rest is the epipolar constraint; where the camera
only turns, both equations count. A sensor is reduced to its motion in the same manner by Censi, Franchi,
Marchionni and Oriolo (Simultaneous calibration of odometry and sensor parameters, 2013).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mapweave.agent.arrays import median
from mapweave.agent.calibration.camera_motions import CameraMotions
from mapweave.hybridmap.pose import Array

CAUCHY = 2.3849
"""Sigmas of a residual at which its weight has halved: 95 % efficiency on Gaussian noise (Huber 1981)."""
FLOOR_STEEPNESS = 0.12
"""Rays less below the horizon than this, rad, meet the floor too far off to tell it from other things."""
LEAST_FLOOR_SHARE = 0.08
"""Sigma of a floor point's depth as a share of it; with less parallax it shows nothing."""
FREE_DEPTH = 3.0
"""Spreads of the scene's inverse depths within which a track's is free. One spread draws near floor and far
walls together, which shows as pitch and as a way 0.7 % too long (rendered room); three do not. What is
linearised about has one spread all the same: near the focus of expansion depths are noise, and noise in a
Jacobian passes for information."""
NO_PRIOR = 1e6
"""Spread of inverse depths of which nothing is known, 1/m."""
ITERATIONS = 3


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


@dataclass(frozen=True, eq=False)
class FloorRatios:
    """How far points below the horizon are, by the depth of the floor there.

    Attributes:
        logs: (K,) logarithms of depth over the floor's, negated. Most of what is seen there is floor, so the
            mode is the logarithm of true over assumed way.
        sigmas: (K,) their standard deviations by the matches.
        flatness: (K,) by how much they change with the slope of the floor, 1/rad: cotangents of the angles
            below the horizon.
    """

    logs: Array
    sigmas: Array
    flatness: Array


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
    floor: FloorRatios


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
    x = np.column_stack([pair.before, np.ones(len(pair.before))])
    prior = np.linalg.inv(noise)
    at = predicted[None]
    mean, spread = depth
    shapes = _field(pair.before)
    columns = 6 + shapes.shape[1]
    for iteration in range(ITERATIONS):
        step_to_at = at.since(predicted[None])[0]
        turned = x @ at.rotation[0].T
        rho = _inverse_depths(turned, at.translation[0], pair.after, sigma, (mean, spread))
        y = turned + rho[:, None] * at.translation[0]
        good = y[:, 2] > 0.05
        z = np.where(good, y[:, 2], 1.0)
        seen = y[:, :2] / z[:, None]
        slope = _projected(at.translation[0], seen, z)
        length = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
        residual = pair.after - seen - slope * (mean - rho)[:, None]
        jacobian = np.concatenate(
            [_jacobian(seen, z, rho, slope / length, mean), slope[:, :, None] * shapes[:, None]], axis=2
        )
        # (sigma^2 I + spread^2 g g')^-1 by Sherman and Morrison.
        gain = 1.0 / ((sigma / spread) ** 2 + (slope**2).sum(1))
        along_r = (slope * residual).sum(1)
        along_j = np.einsum("ni,nij->nj", slope, jacobian)
        chi2 = ((residual**2).sum(1) - gain * along_r**2) / sigma**2
        weight = good / (1.0 + chi2 / CAUCHY**2) / sigma**2
        left = (weight[:, None, None] * jacobian).reshape(-1, columns)
        matrix = left.T @ jacobian.reshape(-1, columns) - ((weight * gain)[:, None] * along_j).T @ along_j
        vector = left.T @ residual.reshape(-1) - along_j.T @ (weight * gain * along_r)
        matrix, vector = _without_field(matrix, vector, FREE_DEPTH * spread)
        step = np.linalg.solve(matrix + prior, vector - prior @ step_to_at)
        if iteration < ITERATIONS - 1:
            at = at.stepped(step[None])
    agreeing = good & (chi2 < 9.0)
    depths = rho[agreeing]
    typical = (median(depths), float(depths.std())) if agreeing.sum() > 5 else depth
    across = np.abs(residual[:, 0] * slope[:, 1] - residual[:, 1] * slope[:, 0])
    scatter = 1.4826 * median(across / length[:, 0])
    floor = floor_ratios(pair, at[0], floor_sigma)
    return PairInformation(at[0], matrix, vector, int(agreeing.sum()), typical, scatter, floor)


def with_floor(information: PairInformation, pair: ImagePair, floor_sigma: float) -> PairInformation:
    """What a reduced pair says with the points of its floor."""
    return replace(information, floor=floor_ratios(pair, information.at, floor_sigma))


def floor_ratios(pair: ImagePair, at: CameraMotions, track_sigma: float) -> FloorRatios:
    """Depths of tracks and matches below the horizon.

    Args:
        pair: the points.
        at: one motion.
        track_sigma: standard deviation of a track.
    """
    before = np.concatenate([pair.before, pair.floor.before])
    after = np.concatenate([pair.after, pair.floor.after])
    sigma = np.concatenate([np.full(len(pair.before), track_sigma), pair.floor.sigmas])
    x = np.column_stack([before, np.ones(len(before))])
    turned = x @ at.rotation.T
    # What is typical in this scene must not draw the floor to it.
    inverse_depth = _inverse_depths(turned, at.translation, after, track_sigma, (0.0, NO_PRIOR))
    floor_depth = x @ at.floor
    steepness = floor_depth / np.linalg.norm(at.floor)
    steep = steepness > FLOOR_STEEPNESS
    floor_depth = np.where(steep, floor_depth, 1.0)
    y = turned + floor_depth[:, None] * at.translation
    z = np.maximum(y[:, 2], 0.05)
    parallax = np.linalg.norm(_projected(at.translation, y[:, :2] / z[:, None], z), axis=1) * floor_depth
    precise = steep & (sigma < LEAST_FLOOR_SHARE * parallax)
    logs = np.log(np.clip(inverse_depth[precise] / floor_depth[precise], 0.05, 20.0))
    return FloorRatios(logs, sigma[precise] / parallax[precise], 1.0 / steepness[precise])


def _projected(direction: Array, seen: Array, z: Array) -> Array:
    """(N, 2) how points seen at (N, 2), at depths (N,), move in the image along a direction (3,)."""
    moved: Array = (direction[:2] - seen * direction[2]) / z[:, None]
    return moved


def _inverse_depths(
    turned: Array, translation: Array, after: Array, sigma: float, depth: tuple[float, float]
) -> Array:
    """(N,) most likely inverse depths, not below zero: two equations linear in each, and a prior.

    From y = a + rho t: (a_z + rho t_z) (u, v) = (a_x + rho t_x, a_y + rho t_y).
    """
    mean, spread = depth
    slope = translation[:2] - after * translation[2]
    constant = after * turned[:, 2:] - turned[:, :2]
    scale = np.maximum(turned[:, 2], 0.05) ** 2 * sigma**2
    information = (slope**2).sum(1) / scale + 1.0 / spread**2
    best: Array = ((slope * constant).sum(1) / scale + mean / spread**2) / information
    return np.maximum(best, 0.0)


def _jacobian(seen: Array, z: Array, rho: Array, along: Array, mean: float) -> Array:
    """(N, 2, 6) of the predicted coordinates with respect to a step; (N, 2) `along` each point's line.

    A depth is estimated from the very residual along the line on which the point may lie. So along that line
    the depth known beforehand takes its place: a product of one noise with itself has a mean.
    """
    u, v = seen.T
    jacobian = np.zeros((len(seen), 2, 6))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, :, 2] = -seen
    shared = (mean - rho)[:, None] * np.einsum("ni,nij->nj", along, jacobian[:, :, :3])
    jacobian[:, :, :3] *= rho[:, None, None]
    jacobian[:, :, :3] += along[:, :, None] * shared[:, None]
    jacobian[:, :, :3] /= z[:, None, None]
    # omega x y, projected; y / z = (u, v, 1).
    jacobian[:, 0, 3], jacobian[:, 0, 4], jacobian[:, 0, 5] = -u * v, 1.0 + u * u, -v
    jacobian[:, 1, 3], jacobian[:, 1, 4], jacobian[:, 1, 5] = -1.0 - v * v, u * v, u
    return jacobian


def _field(before: Array) -> Array:
    """(N, 6) shapes of which the inverse depths of a scene are made: a polynomial over the image."""
    u, v = (before / np.abs(before).max(axis=0)).T
    return np.column_stack([1.0 + 0.0 * u, u, v, u * u, u * v, v * v])


def _without_field(matrix: Array, vector: Array, spread: float) -> tuple[Array, Array]:
    """Eliminate the field of depths: what is assumed of depths must tell nothing of the way."""
    inner = matrix[6:, 6:] + np.eye(len(matrix) - 6) / spread**2
    cross = np.linalg.solve(inner, np.column_stack([matrix[6:, :6], vector[6:]]))
    return matrix[:6, :6] - matrix[:6, 6:] @ cross[:, :6], vector[:6] - matrix[:6, 6:] @ cross[:, 6]
