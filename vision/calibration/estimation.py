"""Least squares over views: intrinsics, the board's poses, outliers, and the covariance of the intrinsics.

Zhang (2000) with the poses eliminated (Schur complement), as each view has its own pose.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.pose import Array
from mapweave.vision.calibration.projection import COEFFICIENTS, FOCAL, Projected, project, rays_of
from mapweave.vision.calibration.views import FEWEST_CORNERS, BoardView
from mapweave.vision.lens import LensModel

STEPS = 60
"""Of Levenberg and Marquardt, at most."""
CONVERGED = 1e-8
"""Relative change of the cost at which they end."""
HUBER = 2.0
"""Standard deviations from which a residual counts linearly while outliers are still in."""
REJECTED = 4.5
"""Standard deviations from which a corner is an outlier: one in 1e5 of a Gaussian's."""
LEAST_SIGMA = 0.02
"""px; no detector is better."""
MAD = 1.4826
"""Standard deviation over median absolute value of a Gaussian."""
FAR_OFF = 4.0
"""A view whose median residual is so many times that of the others is left out for the time being."""
ROUNDS = 6
"""Of leaving out corners, at most."""
FEW = 12
"""Views from which the first focal length is found."""
STARTS = 9
"""Focal lengths that are tried first."""
WIDEST_START = 3.6
"""Tangent of the angle from the axis; corners further out are left out of the first poses."""
UNKNOWN_POSE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 100.0])
"""Of a view that has none yet: far away, so that it fits nowhere."""
NEAR_PX = 4.0
"""Corners that agree on a first pose."""


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """Lens, poses and noise as a set of views shows them.

    Attributes:
        model: of the lens.
        intrinsics: (4 + K,) fx, fy, cx, cy, px, and the coefficients.
        covariance: (4 + K, 4 + K) of them.
        poses: (V, 6) camera_from_target of each view: rotation vector and translation, m.
        kept: for each view, (N,) which corners are no outliers; none of a view that is left out.
        sigma_px: standard deviation of a corner in one direction.
    """

    model: LensModel
    intrinsics: Array
    covariance: Array
    poses: Array
    kept: tuple[NDArray[np.bool_], ...]
    sigma_px: float


def fit(views: Sequence[BoardView], model: LensModel) -> LensEstimate:
    """Estimate from nothing.

    Raises:
        Refused: the views are too few.
        InvalidValue: they explain no lens.
    """
    if len(views) < 3:
        seen = counted(len(views), "view")
        raise Refused(f"{seen} of the target; three are the least, ten or more are good")
    found = _plausible(views, _first(views, model))
    narrow = np.zeros(len(found.intrinsics), np.bool_)
    narrow[[0, 1, FOCAL]] = True
    for free in (narrow, narrow, np.ones_like(narrow), np.ones_like(narrow)):
        found = _minimised(views, found, free, robust=True)
        found = _plausible(views, _posed_again(views, found))
    for _ in range(ROUNDS):
        kept = _inliers(views, found)
        if sum(one.any() for one in kept) < 3:
            raise InvalidValue(
                "the views contradict each other: is the board flat, and are its numbers right?"
            )
        same = all(np.array_equal(a, b) for a, b in zip(kept, found.kept, strict=True))
        found = _minimised(views, replace(found, kept=kept), np.ones_like(narrow), robust=False)
        if same:
            break
    return _with_covariance(views, found)


def refit(views: Sequence[BoardView], found: LensEstimate, which: Sequence[int]) -> LensEstimate:
    """Estimate again from some of the views, beginning at what all of them show."""
    chosen = [views[k] for k in which]
    begun = replace(found, poses=found.poses[list(which)], kept=tuple(found.kept[k] for k in which))
    return _minimised(chosen, begun, np.ones(len(found.intrinsics), np.bool_), robust=False)


def residuals_of_held_out(
    views: Sequence[BoardView], found: LensEstimate, poses: Array, kept: Sequence[NDArray[np.bool_]]
) -> Array:
    """(M, 2) px: corners of other views, whose poses alone are estimated.

    Args:
        views: that were held out.
        found: from the others.
        poses: (V, 6) of the views, to begin with.
        kept: for each view, (N,) which corners count.
    """
    begun = replace(found, poses=poses, kept=tuple(kept))
    posed = _minimised(views, begun, np.zeros(len(found.intrinsics), np.bool_), robust=False)
    return np.concatenate([r[k] for r, k in zip(_residuals(views, posed), posed.kept, strict=True)])


def _first(views: Sequence[BoardView], model: LensModel) -> LensEstimate:
    """The best of some focal lengths, without distortion."""
    width, height = views[0].image_size
    few = views[:: math.ceil(len(views) / FEW)]
    best: tuple[float, Array] | None = None
    for focal in width * np.geomspace(0.25, 3.0, STARTS):
        middle = [focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)]
        intrinsics = np.array([*middle, *[0.0] * COEFFICIENTS[model]])
        cost = float(np.median(_medians(few, _posed(few, model, intrinsics))))
        if best is None or cost < best[0]:
            best = cost, intrinsics
    assert best is not None
    if best[0] > width:
        raise InvalidValue("no focal length explains the views: are the board's numbers right?")
    return _posed(views, model, best[1])


def _posed(views: Sequence[BoardView], model: LensModel, intrinsics: Array) -> LensEstimate:
    poses = [_pose(view, model, intrinsics) for view in views]
    known = np.array([UNKNOWN_POSE if pose is None else pose for pose in poses])
    everything = tuple(np.ones(len(view.points), np.bool_) for view in views)
    return LensEstimate(model, intrinsics, np.zeros((0, 0)), known, everything, 0.0)


def _pose(view: BoardView, model: LensModel, intrinsics: Array) -> Array | None:
    """camera_from_target of a view by intrinsics alone; a tenth of the corners may be wrong."""
    try:
        rays = rays_of(model, intrinsics, view.pixels)
    except InvalidValue:
        return None
    usable = np.hypot(*np.nan_to_num(rays, nan=np.inf).T) < WIDEST_START
    if usable.sum() < 4:
        return None
    points, rays = view.points[usable], rays[usable]
    _, agree = cv2.findHomography(points[:, :2], rays, cv2.RANSAC, NEAR_PX / intrinsics[0], maxIters=100)
    if agree is not None and agree.sum() >= FEWEST_CORNERS:
        points, rays = points[agree.ravel() == 1], rays[agree.ravel() == 1]
    good, turn, shift = cv2.solvePnP(points[:, None], rays[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not good or not np.isfinite(turn).all() or shift[2, 0] <= 0:
        return None
    return np.concatenate([turn.ravel(), shift.ravel()])


def _posed_again(views: Sequence[BoardView], found: LensEstimate) -> LensEstimate:
    """Views that were led astray by the first intrinsics get poses by the present ones."""
    poses = found.poses.copy()
    for k, (view, pose) in enumerate(zip(views, found.poses, strict=True)):
        other = _pose(view, found.model, found.intrinsics)
        if other is not None:
            costs = [
                np.median(
                    np.abs(project(found.model, found.intrinsics, one, view.points).pixels - view.pixels)
                )
                for one in (pose, other)
            ]
            poses[k] = other if costs[1] < costs[0] else pose
    return replace(found, poses=poses)


def _projected(views: Sequence[BoardView], found: LensEstimate) -> list[Projected]:
    return [
        project(found.model, found.intrinsics, pose, view.points)
        for view, pose in zip(views, found.poses, strict=True)
    ]


def _off(views: Sequence[BoardView], seen: Sequence[Projected]) -> list[Array]:
    """(N, 2) px by which the corners of each view are off where they are projected."""
    return [one.pixels - view.pixels for view, one in zip(views, seen, strict=True)]


def _residuals(views: Sequence[BoardView], found: LensEstimate) -> list[Array]:
    return _off(views, _projected(views, found))


def _medians(views: Sequence[BoardView], found: LensEstimate) -> list[float]:
    """Median residual of each view, px; large where it has no pose."""
    return [
        float(np.median(np.nan_to_num(np.linalg.norm(r, axis=1), nan=1e9, posinf=1e9)))
        for r in _residuals(views, found)
    ]


def _spread(residuals: Sequence[Array], kept: Sequence[NDArray[np.bool_]]) -> float:
    """Robust standard deviation, px."""
    flat = np.concatenate([r[k].ravel() for r, k in zip(residuals, kept, strict=True)])
    return max(MAD * float(np.median(np.abs(flat))), LEAST_SIGMA)


def _plausible(views: Sequence[BoardView], found: LensEstimate) -> LensEstimate:
    """All corners of views that fit about as well as the others; a view of something else fits nowhere."""
    off = _medians(views, found)
    limit = FAR_OFF * max(float(np.median(off)), LEAST_SIGMA)
    kept = tuple(np.full(len(view.points), one <= limit) for view, one in zip(views, off, strict=True))
    return replace(found, kept=kept)


def _inliers(views: Sequence[BoardView], found: LensEstimate) -> tuple[NDArray[np.bool_], ...]:
    """Corners within a few deviations; a view with too few of them is left out."""
    residuals = _residuals(views, found)
    limit = REJECTED * _spread(residuals, found.kept)
    kept = [np.asarray(np.abs(r).max(axis=1) <= limit) for r in residuals]
    return tuple(k if k.sum() >= max(FEWEST_CORNERS, len(k) / 2) else np.zeros_like(k) for k in kept)


def _minimised(
    views: Sequence[BoardView], begun: LensEstimate, free: NDArray[np.bool_], robust: bool
) -> LensEstimate:
    """Levenberg and Marquardt over the free intrinsics and all poses."""
    at, damping = begun, 1e-3
    # OpenCV works out the slopes with the pixels: they are kept for the next step.
    seen = _projected(views, at)
    residuals = _off(views, seen)
    scale = HUBER * _spread(residuals, at.kept) if robust else np.inf
    cost = _cost(residuals, at.kept, scale)
    for _ in range(STEPS):
        by_all, towards, solve = _normal(views, seen, at.kept, free, scale)
        for _ in range(8):
            step, turns = _step(by_all, towards, solve, free, damping)
            tried = replace(at, intrinsics=at.intrinsics + step, poses=at.poses + turns)
            tried_seen = _projected(views, tried)
            tried_cost = _cost(_off(views, tried_seen), at.kept, scale)
            if np.isfinite(tried_cost) and tried_cost < cost and (tried.intrinsics[:2] > 1.0).all():
                break
            damping *= 8.0
        else:
            return at
        change = (cost - tried_cost) / max(cost, 1e-12)
        at, seen, cost, damping = tried, tried_seen, tried_cost, max(damping / 8.0, 1e-12)
        if change < CONVERGED:
            break
    return at


def _cost(residuals: Sequence[Array], kept: Sequence[NDArray[np.bool_]], scale: float) -> float:
    """Huber's, of the length of each residual."""
    off = np.linalg.norm(np.concatenate([r[k] for r, k in zip(residuals, kept, strict=True)]), axis=1)
    return float(np.where(off <= scale, off**2, 2.0 * min(scale, 1e9) * off - min(scale, 1e9) ** 2).sum())


Blocks = list[tuple[Array, Array, Array]]


def _normal(
    views: Sequence[BoardView],
    projected: Sequence[Projected],
    kept: Sequence[NDArray[np.bool_]],
    free: NDArray[np.bool_],
    scale: float,
) -> tuple[Array, Array, Blocks]:
    """Normal equations: (F, F) and (F,) of the free intrinsics; pose, coupling, right side of each view."""
    count = int(free.sum())
    by_all, towards, blocks = np.zeros((count, count)), np.zeros(count), []
    for view, seen, which in zip(views, projected, kept, strict=True):
        if not which.any():
            blocks.append((np.eye(6), np.zeros((count, 6)), np.zeros(6)))
            continue
        off = seen.pixels - view.pixels
        # One product of all columns: intrinsics, the pose's six, and what is off.
        columns = np.concatenate([seen.by_intrinsics[..., free], seen.by_pose, off[..., None]], axis=2)[which]
        if scale < np.inf:
            length = np.linalg.norm(off[which], axis=1)
            columns *= np.sqrt(np.minimum(1.0, scale / np.maximum(length, 1e-12)))[:, None, None]
        flat = columns.reshape(-1, count + 7)
        product = flat.T @ flat
        by_all += product[:count, :count]
        towards += product[:count, -1]
        blocks.append((product[count:-1, count:-1], product[:count, count:-1], product[count:-1, -1]))
    return by_all, towards, blocks


def _step(
    by_all: Array, towards: Array, blocks: Blocks, free: NDArray[np.bool_], damping: float
) -> tuple[Array, Array]:
    """Steps of the intrinsics and the poses; the poses are eliminated."""
    own, coupling, side = (np.stack(column) for column in zip(*blocks, strict=True))
    by_turn = coupling @ _inverses(own + damping * own * np.eye(6))
    reduced = (
        by_all + damping * np.diag(np.diag(by_all)) - (by_turn @ coupling.transpose(0, 2, 1)).sum(axis=0)
    )
    right = towards - (by_turn @ side[..., None])[..., 0].sum(axis=0)
    step = np.zeros(len(free))
    if free.any():
        # Scaled: focal lengths are hundreds, coefficients thousandths.
        size = 1.0 / np.sqrt(np.maximum(np.diag(by_all), 1e-12))
        scaled = reduced * np.outer(size, size)
        step[free] = -size * np.linalg.lstsq(scaled, size * right, rcond=1e-14)[0]
    rest = side + coupling.transpose(0, 2, 1) @ step[free]
    return step, -(_inverses(own + damping * own * np.eye(6)) @ rest[..., None])[..., 0]


def _inverses(own: Array) -> Array:
    """(V, 6, 6) inverses of normal matrices, scaled to a diagonal of 1: a radian is not a metre."""
    size = 1.0 / np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), 1e-12))
    scale = size[:, :, None] * size[:, None, :]
    return np.asarray(np.linalg.inv(own * scale + 1e-12 * np.eye(6)) * scale)


def _with_covariance(views: Sequence[BoardView], found: LensEstimate) -> LensEstimate:
    """Noise from the residuals, and with it the covariance of the intrinsics."""
    free = np.ones(len(found.intrinsics), np.bool_)
    by_all, _, blocks = _normal(views, _projected(views, found), found.kept, free, np.inf)
    own, coupling, _ = (np.stack(column) for column in zip(*blocks, strict=True))
    reduced = by_all - (coupling @ _inverses(own) @ coupling.transpose(0, 2, 1)).sum(axis=0)
    flat = np.concatenate([r[k].ravel() for r, k in zip(_residuals(views, found), found.kept, strict=True)])
    used = sum(bool(k.any()) for k in found.kept)
    free_numbers = max(len(flat) - len(found.intrinsics) - 6 * used, 1)
    variance = float(flat @ flat) / free_numbers
    size = 1.0 / np.sqrt(np.maximum(np.diag(by_all), 1e-12))
    inverse = np.linalg.pinv(reduced * np.outer(size, size), rcond=1e-14, hermitian=True)
    return replace(found, covariance=variance * inverse * np.outer(size, size), sigma_px=variance**0.5)
