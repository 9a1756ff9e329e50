"""Where one view was taken from another when neither knows a depth: planar epipolar geometry.

A pixel is the ray (1, a, b) with a = Y/X to the left and b = Z/X upward, (1, a', b') in the second view. Its
camera stands at (cos phi, sin phi) of the first, at an unknown scale, and looks along theta. Rays of one
point and the baseline lie in one plane, which for cameras that stay level at one height reads, with
psi = theta - phi,

    -a b' cos(phi) + b' sin(phi) + a' b cos(psi) + b sin(psi) = 0.

It is linear in two unit vectors: two points leave a pencil of solutions, of which their equal lengths choose
at most two. What lies at the camera's own height (b = b' = 0) tells nothing in two views. Without a baseline
every phi fits, but theta does not suffer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, wrap_angle
from hybridmap.recognising.epipolar import (
    errors,
    inverse_depths,
    refined,
    refined_turn,
    turn_chi2,
    two_point_solutions,
)


@dataclass(frozen=True)
class BearingSettings:
    """How two views are related.

    Attributes:
        samples: pairs of matches that are tried.
        pixel_sigma: standard deviation of a matched pixel, px.
        gate: largest squared error of an inlier, in its variances; chi-square, 1 degree of freedom.
        behind: a match whose depth is negative by more than this many sigma is wrong.
        least_inliers: fewer give no answer.
        parallax_gate: how many standard deviations of chi-square the matches must miss a pure turn by for
            the direction to count as seen.
        most_direction_sigma: a direction known no better than this is not known, rad.
        rounds: of Gauss-Newton.
        finalists: samples that are refined.
        worse: as wrong matches a sample may have more than the best, as a share of all, to be refined.
        apart: two answers are different if their headings differ by more than this, rad.
        apart_direction: or their directions by more than this, rad.
    """

    samples: int = 200
    pixel_sigma: float = 1.0
    gate: float = 6.63
    behind: float = 3.0
    least_inliers: int = 6
    parallax_gate: float = 4.0
    most_direction_sigma: float = 0.5
    rounds: int = 8
    finalists: int = 6
    worse: float = 0.3
    apart: float = 0.1
    apart_direction: float = 0.4


@dataclass(frozen=True, eq=False)
class BearingFix:
    """Posture of camera b from camera a up to scale.

    Attributes:
        heading: theta, rad, of b's optical axis in a.
        direction: phi, rad, of b's optical centre in a; without meaning if not `directed`.
        covariance: (2, 2) rad^2 of (heading, direction); of the heading alone in [0, 0] if not `directed`.
        directed: whether there is parallax enough to tell a direction at all.
        inverse_depths: (N,) depth in a's view as baseline / depth; NaN where not an inlier.
        inliers: (N,) which matches agree.
        mean_square: mean squared error of the inliers in their variances; 1 is expected.
    """

    heading: float
    direction: float
    covariance: Array
    directed: bool
    inverse_depths: Array
    inliers: NDArray[np.bool_]
    mean_square: float


def rays(pixels: NDArray[np.floating], camera: Camera) -> Array:
    """(N, 2) slopes a (left) and b (up) of pixels (N, 2) px."""
    slopes: Array = (np.array([camera.cx, camera.cy]) - np.asarray(pixels, dtype=np.float64)) / np.array(
        [camera.fx, camera.fy]
    )
    return slopes


def relate(
    pixels_a: NDArray[np.floating],
    camera_a: Camera,
    pixels_b: NDArray[np.floating],
    camera_b: Camera,
    rng: np.random.Generator,
    settings: BearingSettings | None = None,
) -> BearingFix | None:
    """Find where view b was taken from view a, from matches of which some may be wrong.

    Args:
        pixels_a: (N, 2) px, undistorted.
        camera_a: that took a.
        pixels_b: (N, 2) px, the same points in b.
        camera_b: that took b, at the same height as a.
        rng: draws samples.
        settings: how.

    Returns:
        The posture up to scale, or None if too few matches agree on any.

    Raises:
        InvalidValue: pixels that are not (N, 2) and finite, or not as many on both sides.
    """
    return next(iter(relate_all(pixels_a, camera_a, pixels_b, camera_b, rng, settings)), None)


def relate_all(
    pixels_a: NDArray[np.floating],
    camera_a: Camera,
    pixels_b: NDArray[np.floating],
    camera_b: Camera,
    rng: np.random.Generator,
    settings: BearingSettings | None = None,
) -> list[BearingFix]:
    """The same, with all postures that explain the matches in different ways, the likeliest first.

    A few landmarks near the camera's own height often leave two or three, which the next view tells apart.
    """
    s = settings or BearingSettings()
    seen_a, seen_b = np.asarray(pixels_a, np.float64), np.asarray(pixels_b, np.float64)
    fine = seen_a.shape == seen_b.shape == (len(seen_a), 2)
    if not fine or not np.isfinite([seen_a, seen_b]).all():
        raise InvalidValue("bearings: pixels of two views must both be (N, 2), as many, and finite")
    a, b = rays(seen_a, camera_a), rays(seen_b, camera_b)
    sigmas = s.pixel_sigma / np.array([camera_a.fx, camera_b.fx])
    if len(a) < max(s.least_inliers, 2):
        return []
    found: list[tuple[float, BearingFix]] = []
    for sample in _best_samples(a, b, sigmas, s, rng):
        fix = _settled(a, b, sample, sigmas, s)
        if fix is not None and not any(_alike(fix, other, s) for _, other in found):
            hypothesis = np.array([[fix.heading, fix.direction]])
            found.append((float(_costs(a, b, hypothesis, sigmas, s)[0]), fix))
    return [fix for _, fix in sorted(found, key=lambda pair: pair[0])]


def _settled(a: Array, b: Array, sample: Array, sigmas: Array, s: BearingSettings) -> BearingFix | None:
    """Refine a sample on what agrees with it, or None if that is too little."""
    found = sample
    for _ in range(3):
        inliers = _inliers(a, b, found, sigmas, s)
        if inliers.sum() < s.least_inliers:
            return None
        found, covariance = refined(a[inliers], b[inliers], found, sigmas, s.rounds)
        found = _facing(a[inliers], b[inliers], found)
    inliers = _inliers(a, b, found, sigmas, s)
    count = int(inliers.sum())
    if count < s.least_inliers:
        return None
    error2, _ = errors(a[inliers], b[inliers], found[None], sigmas)
    turn, turn_variance = refined_turn(a[inliers], b[inliers], float(found[0]), sigmas)
    # The direction and each depth are what parallax has to explain: as many degrees of freedom.
    gained = turn_chi2(a[inliers], b[inliers], turn, sigmas) - float(error2.sum())
    freedom = count + 1
    directed = gained > freedom + s.parallax_gate * math.sqrt(2.0 * freedom)
    directed = directed and covariance[1, 1] < s.most_direction_sigma**2
    inverse = np.full(len(a), np.nan)
    inverse[inliers] = inverse_depths(a[inliers], b[inliers], found[None])[0][0] if directed else 0.0
    if not directed:
        covariance = np.diag([turn_variance, math.pi**2 / 3.0])
    return BearingFix(
        wrap_angle(float(found[0]) if directed else turn),
        wrap_angle(float(found[1])),
        covariance,
        directed,
        inverse,
        inliers,
        float(error2.mean()),
    )


def _best_samples(
    a: Array, b: Array, sigmas: Array, s: BearingSettings, rng: np.random.Generator
) -> list[Array]:
    """Headings and directions (2,), apart from each other, with which most matches agree."""
    chosen = rng.integers(0, len(a), (s.samples, 2))
    chosen[:, 1] = (chosen[:, 0] + 1 + chosen[:, 1] % (len(a) - 1)) % len(a)
    tried = two_point_solutions(a[chosen], b[chosen])
    kept: list[Array] = []
    costs = _costs(a, b, tried, sigmas, s)
    worst = float(costs.min()) + s.worse * s.gate * len(a)
    for k in np.argsort(costs, kind="stable").tolist():
        if costs[k] > worst:
            break
        off = [np.abs(np.remainder(tried[k] - other + math.pi, 2.0 * math.pi) - math.pi) for other in kept]
        if all((o > (s.apart, s.apart_direction)).any() for o in off):
            kept.append(tried[k])
            if len(kept) == s.finalists:
                break
    return kept


def _costs(a: Array, b: Array, hypotheses: Array, sigmas: Array, s: BearingSettings) -> Array:
    """(H,) squares of the matches' errors, none more than the gate."""
    error2, _ = errors(a, b, hypotheses, sigmas)
    inverse, sigma = inverse_depths(a, b, hypotheses, sigmas)
    costs: Array = np.where(inverse < -s.behind * sigma, s.gate, np.minimum(error2, s.gate)).sum(axis=1)
    return costs


def _alike(one: BearingFix, other: BearingFix, s: BearingSettings) -> bool:
    if abs(wrap_angle(one.heading - other.heading)) > s.apart:
        return False
    return not other.directed or abs(wrap_angle(one.direction - other.direction)) < s.apart_direction


def _inliers(a: Array, b: Array, found: Array, sigmas: Array, s: BearingSettings) -> NDArray[np.bool_]:
    error2, _ = errors(a, b, found[None], sigmas)
    inverse, sigma = inverse_depths(a, b, found[None], sigmas)
    inliers: NDArray[np.bool_] = (error2[0] < s.gate) & (inverse[0] > -s.behind * sigma[0])
    return inliers


def _facing(a: Array, b: Array, found: Array) -> Array:
    """The direction or its opposite, whichever puts what is seen in front."""
    inverse, sigma = inverse_depths(a, b, found[None], np.ones(2))
    if float((inverse / sigma**2).sum()) < 0.0:
        return np.array([found[0], found[1] + math.pi])
    return found
