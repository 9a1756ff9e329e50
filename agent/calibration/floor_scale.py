"""The floor among points below the horizon: the scale of the way, by the height of the camera.

Points are held against the place of the camera that is nearest to them on its way (`floor_path.py`). From
there to where they lie the floor has a slope, one in each pair: of a road ahead that was not driven yet, of
what lies aside in a curve, of a vehicle that pitches on its springs.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

FLOOR_WIDTH = 0.1
"""Of the kernel with which the floor is first looked for among logarithms of depth ratios."""
CENTRES_APART = 0.02
"""Ratios about which it is looked for, as logarithms: so far apart, to 0.6 either way."""
PLAUSIBLE = 0.15
"""Standard deviation of the logarithm of wheel scale beforehand."""
FLOOR_STEPS = 20
"""Of expectation maximisation."""
SLOPE = 0.005
"""Standard deviation of the floor's slope against the vehicle beforehand, rad, and after so many pairs,"""
SLOPE_PAIRS = 10.0
LEAST_SLOPE, MOST_SLOPE = 0.001, 0.01
"""within these: with steeper ones far floor tells nothing any more."""
LEAST_SPREAD = 0.4
"""Points of the floor scatter by no less of what is assumed."""
FLOOR_RANGE = 1.4
"""Of logarithms of depth ratios over which all else is spread: one half above the floor, one below."""
LOGISTIC = 1.702
"""A logistic curve of a Gaussian's sigmas, so many times as steep, is its integral to within 0.01."""
NOWHERE = 1e-12
"""Density of points where neither the floor nor anything else is: far below a floor without false points."""
FLOOR_FLAT = 0.03
"""Standard deviation of a floor point's logarithm of depth besides its track's: no floor is quite flat."""
FLOOR_CONTRAST = 3.0
"""The floor must be so many times as dense as all else where it is densest, else it is not the floor."""
FLOOR_SIGMA = 0.005
"""Least standard deviation of a scale by the floor: contact edges, mats, slopes."""
LEAST_BLOCKS = 8
"""Blocks of pairs that see the floor; the scatter of fewer tells no sigma."""
LEAST_FLOOR = 60
"""Points on the floor; with fewer nothing is said of it."""


@dataclass(frozen=True)
class FloorScale:
    """What the floor shows.

    Attributes:
        log: logarithm of true over assumed way, for the height that was assumed.
        sigma: its standard deviation.
        tracks: how many points are on the floor.
        flatness: by how much `log` changes with a slope that all pairs have in common, 1/rad.
    """

    log: float
    sigma: float
    tracks: int
    flatness: float


def floor_scale(
    logs: Array, sigmas: Array, flatness: Array, pairs: NDArray[np.int64], block: int
) -> FloorScale | None:
    """Tell the floor from what stands on it.

    Points of the floor scatter about one ratio. What stands on it is spread evenly from there up, and some
    points are found wrongly, above or below. A mixture of three, by expectation maximisation, begun where the
    density rises: things stand on the floor, nothing is below it. The shares above and below are found along
    with the floor; held equal, the feet of walls and boxes would count as floor.

    Args:
        logs: (N,) logarithms of the declared over the measured height of the camera.
        sigmas: (N,) standard deviations of them by their tracks.
        flatness: (N,) by how much they change with the floor's slope, 1/rad: distances from the camera's
            nearest place, along the floor, over its height.
        pairs: (N,) number of the pair of images that each belongs to, ascending.
        block: pairs in a row whose errors may go together.

    Returns:
        None where no floor can be found.
    """
    if len(logs) < LEAST_FLOOR or len(np.unique(pairs // block)) < LEAST_BLOCKS:
        return None
    sigmas = np.hypot(sigmas, FLOOR_FLAT)
    apart = round(4.0 * FLOOR_WIDTH / CENTRES_APART)
    centres: Array = CENTRES_APART * np.arange(-30.0 - apart, 30.0)
    density = _density(logs, sigmas, centres)
    centres, rise = centres[apart:], density[apart:] - density[:-apart]
    plausible = np.exp(-0.5 * (centres / PLAUSIBLE) ** 2)
    mode = float(centres[int((rise * plausible).argmax())])
    numbers, own = np.unique(pairs, return_inverse=True)
    slopes, slope = np.zeros(len(numbers)), SLOPE
    floor, above, below, scale = 0.5, 0.25, 0.25, 1.0
    for _ in range(FLOOR_STEPS):
        spread, off = scale * sigmas, logs - mode - slopes[own] * flatness
        on = floor * np.exp(-0.5 * (off / spread) ** 2) / (math.sqrt(math.tau) * spread)
        # Points scatter, those at the foot of a thing too: what begins at the floor begins gradually.
        begun = 0.5 + 0.5 * np.tanh(0.5 * LOGISTIC * off / spread)
        over, under = above * begun / (0.5 * FLOOR_RANGE), below * (1.0 - begun) / (0.5 * FLOOR_RANGE)
        total = on + over + under + NOWHERE
        share = on / total
        floor, above, below = (float((part / total).mean()) for part in (on, over, under))
        pull = share / spread**2
        square = (share * (off / sigmas) ** 2).sum() / max(share.sum(), 1e-9)
        # The mode is common, each pair has a slope: its row of the normal equations is eliminated.
        flat = pull * flatness
        level, cross = np.bincount(own, pull), np.bincount(own, flat)
        steep = np.bincount(own, flat * flatness) + 1.0 / slope**2
        off = logs - mode
        rest, tilt = np.bincount(own, pull * off), np.bincount(own, flat * off)
        pulls, stiff = rest - cross * tilt / steep, level - cross**2 / steep
        more = float(pulls.sum() / max(stiff.sum(), 1e-9))
        mode, slopes = mode + more, (tilt - more * cross) / steep
        slope = math.sqrt(
            ((slopes**2 + 1.0 / steep).sum() + SLOPE_PAIRS * SLOPE**2) / (len(slopes) + SLOPE_PAIRS)
        )
        slope = float(np.clip(slope, LEAST_SLOPE, MOST_SLOPE))
        scale = float(np.clip(math.sqrt(square), LEAST_SPREAD, 1.0))
    off = logs - mode - slopes[own] * flatness
    blocks = np.bincount(numbers // block, np.bincount(own, pull * off))
    # Where it is not sure what is floor, the mixture is less stiff than its parts.
    sure = float((pull * (1.0 - (1.0 - share) * (off / spread) ** 2)).sum() / max(pull.sum(), 1e-9))
    stiffness = sure * float(stiff.sum())
    tracks = int(share.sum())
    densest = floor / (math.sqrt(math.tau) * float(np.median(spread)))
    if tracks < LEAST_FLOOR or stiffness <= 0.0 or densest < FLOOR_CONTRAST * (1.0 - floor) / FLOOR_RANGE:
        return None
    common = float((cross / steep).sum()) / (slope**2 * max(float(stiff.sum()), 1e-9))
    return FloorScale(mode, max(float(np.linalg.norm(blocks)) / stiffness, FLOOR_SIGMA), tracks, common)


def _density(logs: Array, sigmas: Array, centres: Array) -> Array:
    """(M,) how dense (N,) ratios are about (M,) centres, each spread by its sigma and the kernel."""
    variance = FLOOR_WIDTH**2 + sigmas**2
    off = np.square(logs - centres[:, None])
    off *= -0.5 / variance
    return np.asarray(np.exp(off, out=off) @ (1.0 / np.sqrt(variance)))
