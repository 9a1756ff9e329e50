"""A camera from views of a target: which lens, how sure, how well it explains other views, what lacks."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.vision.calibration.coverage import PLACES, ViewCoverage, coverage_of, diverse
from mapweave.vision.calibration.estimation import LensEstimate, fit, refit, residuals_of_held_out
from mapweave.vision.calibration.projection import project, rays_of
from mapweave.vision.calibration.views import BoardView
from mapweave.vision.equidistant import WIDEST
from mapweave.vision.image_reduction import reduced_size
from mapweave.vision.lens import LensModel

MOST_VIEWS = 50
"""More add time, not accuracy."""
FOLDS = 5
"""Parts into which the views are cut; each is held out once."""
LEAST_VIEWS = 4
"""Two parts of two views."""
MUCH_BETTER = 0.9
"""An equidistant lens is taken if it explains held out views with less than this of the other's error."""
MOST_ERROR = 0.7
"""px of an image as agents work on it, reduced if it is large, of the worst projection and of corners of
views held out: the noise of a pixel that the agent tracks (`pixel_sigma`)."""
SQUARE_PIXELS = 0.02
"""Share by which fx and fy differ at most. Pixels are square; a printer that stretches a page is not."""
GRID = (13, 9)
"""Columns and rows of cells in the image; the uncertainty is computed in the middle of each."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """What came of it.

    Attributes:
        image_size: width and height, px.
        fit: intrinsics with covariance.
        views: that were used; those of the fit.
        coverage: of these views.
        uncertainty_px: (9, 13) standard deviation of a projection in its worst direction, after the best
            rotation of the camera; NaN where the agent does not look.
        held_out_px: RMS error of corners of held out views, in one direction.
        compared: held out error of each lens that was tried, px.
        problems: why it is not good enough, and what to do; empty if it is.
    """

    image_size: tuple[int, int]
    fit: LensEstimate
    views: tuple[BoardView, ...]
    coverage: ViewCoverage
    uncertainty_px: Array
    held_out_px: float
    compared: dict[LensModel, float]
    problems: tuple[str, ...]

    @property
    def worst_px(self) -> float:
        """The largest uncertainty in the image."""
        return float(np.nanmax(self.uncertainty_px))

    @property
    def outliers(self) -> int:
        """Corners that were left out."""
        return sum(int((~kept).sum()) for kept in self.fit.kept)


def calibrate_camera(views: Sequence[BoardView], model: LensModel | None = None) -> CameraCalibration:
    """Calibrate.

    Args:
        views: of one camera, all of the same size; the most different ones are used.
        model: of the lens; None takes the one that explains held out views better.

    Raises:
        InvalidValue: the views are of different sizes or too few, or explain no lens.
    """
    counts = Counter(view.image_size for view in views)
    if len(counts) > 1:
        rarest = min(counts, key=lambda size: counts[size])
        odd = next(view.name for view in views if view.image_size == rarest)
        which = f"; {odd} is {rarest[0]}x{rarest[1]}" if odd else ""
        raise InvalidValue(
            f"images of different sizes: {', '.join(f'{w}x{h}' for w, h in sorted(counts))}{which}"
        )
    chosen = diverse(views, MOST_VIEWS)
    fits: dict[LensModel, LensEstimate] = {}
    failure: InvalidValue | None = None
    for one in [model] if model is not None else list(LensModel):
        try:
            fits[one] = fit(chosen, one)
        except InvalidValue as error:
            failure = error
    if not fits:
        assert failure is not None
        raise failure
    # A lens of the wrong kind leaves out what it cannot explain: all are judged by what any of them keeps.
    judged = [np.any(kept, axis=0) for kept in zip(*(one.kept for one in fits.values()), strict=True)]
    errors = {one: held_out_error(chosen, fitted, judged) for one, fitted in fits.items()}
    best = next(iter(fits))
    if errors.get(LensModel.EQUIDISTANT, math.inf) < MUCH_BETTER * errors[best]:
        best = LensModel.EQUIDISTANT
    held_out, fitted = errors[best], fits[best]
    used = [view for view, kept in zip(chosen, fitted.kept, strict=True) if kept.any()]
    coverage = coverage_of(used)
    try:
        uncertainty = uncertainty_of(fitted, chosen[0].image_size)
        problems = [*coverage.missing, *_problems(fitted, chosen[0].image_size, uncertainty, held_out)]
    except InvalidValue as error:
        uncertainty = np.full(GRID[::-1], math.inf)
        problems = [*coverage.missing, str(error).removeprefix("camera: ")]
    return CameraCalibration(
        chosen[0].image_size, fitted, tuple(chosen), coverage, uncertainty, held_out,
        errors, tuple(problems),
    )  # fmt: skip


def held_out_error(
    views: Sequence[BoardView], found: LensEstimate, judged: Sequence[NDArray[np.bool_]]
) -> float:
    """RMS error of a corner in one direction, px, over parts of the views that the fit does without.

    Args:
        views: all.
        found: from all of them.
        judged: for each view, (N,) which corners count.
    """
    used = [k for k, kept in enumerate(judged) if kept.any()]
    if len(used) < LEAST_VIEWS:
        return math.inf
    folds = min(FOLDS, len(used) // 2)
    squares, count = 0.0, 0
    for part in range(folds):
        held = used[part::folds]
        others = refit(views, found, [k for k in used if k not in held])
        off = residuals_of_held_out(
            [views[k] for k in held], others, found.poses[held], [judged[k] for k in held]
        )
        squares, count = squares + float((off**2).sum()), count + off.size
    return math.sqrt(squares / count)


def uncertainty_of(found: LensEstimate, image_size: tuple[int, int]) -> Array:
    """Standard deviation of projections, see `CameraCalibration.uncertainty_px`.

    An error of the intrinsics that acts as a rotation of the camera is none: nothing but the mount tells
    where a camera looks. So the best rotation is taken out of each (as mrcal does).

    Raises:
        InvalidValue: the lens folds in the image.
    """
    width, height = image_size
    across, down = (
        (np.arange(n) + 0.5) / n * side - 0.5 for n, side in zip(GRID, (width, height), strict=True)
    )
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = rays_of(found.model, found.intrinsics, pixels)
    looked = np.isfinite(rays).all(axis=1)
    if found.model is LensModel.EQUIDISTANT:
        looked &= np.hypot(*np.nan_to_num(rays, nan=9.9).T) <= math.tan(WIDEST)
    points = np.column_stack([rays[looked], np.ones(int(looked.sum()))])
    seen = project(found.model, found.intrinsics, np.zeros(6), points)
    if not looked.any() or np.abs(seen.pixels - pixels[looked]).max() > 0.5:
        raise InvalidValue("the lens folds the image over: more views are needed near the image's corners")
    by_turn = seen.by_pose[..., :3].reshape(-1, 3)
    by_intrinsics = seen.by_intrinsics.reshape(len(by_turn), -1)
    left = by_intrinsics - by_turn @ np.linalg.lstsq(by_turn, by_intrinsics, rcond=None)[0]
    left = left.reshape(len(points), 2, -1)
    covariance = left @ found.covariance @ left.transpose(0, 2, 1)
    out = np.full(len(pixels), np.nan)
    out[looked] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0))
    return out.reshape(GRID[1], GRID[0])


def _problems(
    found: LensEstimate, image_size: tuple[int, int], uncertainty: Array, held_out: float
) -> list[str]:
    limit = MOST_ERROR * image_size[0] / reduced_size(*image_size).width
    problems = []
    worst = float(np.nanmax(uncertainty))
    if not worst <= limit:
        row, column = np.unravel_index(int(np.nanargmax(uncertainty)), uncertainty.shape)
        place = PLACES[int(row) * 3 // GRID[1]][int(column) * 3 // GRID[0]]
        problems.append(
            f"projections are uncertain by {worst:.2f} px in the {place}, {limit:.2g} px are "
            "good: more views there, near and tilted"
        )
    if math.isinf(held_out):
        problems.append(f"none of so few views can be held out: show the board at least {LEAST_VIEWS} times")
    elif not held_out <= limit:
        problems.append(
            f"corners of views held out are {held_out:.2f} px off, {limit:.2g} px are good: is "
            "the board flat and still, the image sharp, and the lens of this kind?"
        )
    fx, fy = found.intrinsics[:2]
    sigma = math.sqrt(found.covariance[0, 0] + found.covariance[1, 1])
    if abs(fx - fy) > SQUARE_PIXELS * fx + 3.0 * sigma:
        problems.append(
            f"fx is {fx:.1f} and fy {fy:.1f} px, but pixels are square: was the target printed at 100 %? "
            "Hold a ruler to both of its scales"
        )
    return problems
