"""Estimation against truth and finite differences: the stated sigma is the error, bad sets are refused."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.vision.calibration.camera_calibration import (
    GRID,
    calibrate_camera,
    held_out_error,
    uncertainty_of,
)
from mapweave.vision.calibration.coverage import coverage_of, diverse
from mapweave.vision.calibration.estimation import fit
from mapweave.vision.calibration.projection import project
from mapweave.vision.calibration.target import CalibrationTarget
from mapweave.vision.calibration.views import BoardView, placement_of
from mapweave.vision.lens import LensModel
from tests.quick import first_quick
from tests.vision.calibration.boards import FISHEYE, PINHOLE, SIZE, corner_views, pixels_of

MODELS = [(LensModel.RADIAL_TANGENTIAL, PINHOLE), (LensModel.EQUIDISTANT, FISHEYE)]
NOISE_PX = 0.15


@pytest.mark.parametrize(("model", "true"), MODELS)
def test_derivatives_are_those_of_finite_differences(model: LensModel, true: np.ndarray):
    pose, points = np.array([0.2, -0.1, 0.05, -0.05, -0.1, 0.4]), CalibrationTarget().corners
    seen = project(model, true, pose, points)
    assert np.allclose(seen.pixels, pixels_of(true, pose, points), atol=1e-9)
    numbers, slopes = np.concatenate([true, pose]), np.concatenate([seen.by_intrinsics, seen.by_pose], axis=2)
    for k in range(len(numbers)):
        step = np.zeros(len(numbers))
        step[k] = 1e-6 * max(1.0, abs(numbers[k]))
        ends = [numbers + step, numbers - step]
        two = [project(model, one[: len(true)], one[len(true) :], points).pixels for one in ends]
        numeric = (two[0] - two[1]) / (2.0 * step[k])
        assert np.allclose(numeric, slopes[..., k], rtol=1e-4, atol=1e-4 * np.abs(numeric).max())


@pytest.mark.slow
@pytest.mark.parametrize(("model", "true"), MODELS)
def test_the_stated_uncertainty_is_the_error_over_draws(model: LensModel, true: np.ndarray):
    rng = np.random.default_rng(5)
    draws, squares, shares = 12, [], []
    middles = ((np.arange(n) + 0.5) / n * side - 0.5 for n, side in zip(GRID, SIZE, strict=True))
    pixels = np.stack(np.meshgrid(*middles), axis=-1)
    for _ in range(draws):
        found = fit(corner_views(rng, true, 12, NOISE_PX), model)
        off = found.intrinsics - true
        squares.append(off @ np.linalg.solve(found.covariance, off))
        assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.15)
        # Where the true rays are seen, after the best rotation of the camera.
        stated = uncertainty_of(found, SIZE)
        looked = np.isfinite(stated)
        rays = _rays(true, pixels[looked])
        here = project(model, found.intrinsics, np.zeros(6), rays)
        error = (here.pixels - pixels[looked]).ravel()
        turn = here.by_pose[..., :3].reshape(-1, 3)
        error = (error - turn @ np.linalg.lstsq(turn, error, rcond=None)[0]).reshape(-1, 2)
        shares.append(np.mean((error**2).sum(axis=1) / stated[looked] ** 2))
    mean = float(np.mean(squares)) / len(true)
    spread = math.sqrt(2.0 / (draws * len(true)))
    assert abs(mean - 1.0) < 3.0 * spread, "NEES of the intrinsics is 1 a dimension"
    # Both directions of a pixel count, and the stated one is that of the worst: 1 to 2 times its square.
    assert 0.5 < np.mean(shares) < 2.2


def _rays(true: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N, 3) by Newton's method on OpenCV's projection."""
    rays = np.column_stack([(pixels - true[2:4]) / true[:2], np.ones(len(pixels))])
    for _ in range(60):
        now = pixels_of(true, np.zeros(6), rays)
        slopes = [(pixels_of(true, np.zeros(6), rays + 1e-6 * np.eye(3)[k]) - now) / 1e-6 for k in range(2)]
        step = np.linalg.solve(np.stack(slopes, axis=-1), (pixels - now)[..., None])[..., 0]
        rays[:, :2] += np.clip(step, -0.1, 0.1)
    return rays


@pytest.mark.parametrize(("model", "true"), first_quick(MODELS, 1))
def test_outliers_are_left_out_and_the_lens_is_found(model: LensModel, true: np.ndarray):
    rng = np.random.default_rng(2)
    views = corner_views(rng, true, 30, NOISE_PX)
    for view in views:
        wrong = rng.random(len(view.pixels)) < 0.03
        view.pixels[wrong] += rng.uniform(3.0, 20.0, (int(wrong.sum()), 2))
    views[3] = replace(views[3], pixels=rng.permutation(views[3].pixels))
    found = calibrate_camera(views)
    assert found.fit.model is model
    sigmas = np.sqrt(found.fit.covariance.diagonal())
    assert (np.abs(found.fit.intrinsics - true) < 4.0 * sigmas).all()
    assert found.fit.sigma_px == pytest.approx(NOISE_PX, rel=0.1)
    assert not found.fit.kept[3].any()
    assert found.held_out_px == pytest.approx(NOISE_PX, rel=0.2)
    worse = {one: error for one, error in found.compared.items() if one is not model}
    assert all(error > found.held_out_px for error in worse.values())


def held_out_by_opencv(views: list[BoardView], folds: int) -> float:
    """RMS error of corners in one direction, px: each so-manieth view held out, the others calibrated."""
    off = []
    for part in range(folds):
        others = [view for k, view in enumerate(views) if k % folds != part]
        points, pixels = (
            [getattr(v, name).astype(np.float32) for v in others] for name in ("points", "pixels")
        )
        ends = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        _, matrix, lens, *_ = cv2.calibrateCamera(points, pixels, SIZE, None, None, criteria=ends)  # type: ignore[call-overload]
        for view in views[part::folds]:
            _, turn, shift = cv2.solvePnP(view.points, view.pixels, matrix, lens)
            turn, shift = cv2.solvePnPRefineLM(view.points, view.pixels, matrix, lens, turn, shift)
            seen, _ = cv2.projectPoints(view.points, turn, shift, matrix, lens)
            off.append(seen[:, 0] - view.pixels)
    return float(np.sqrt(np.square(np.concatenate(off)).mean()))


@pytest.mark.parametrize("seed", [3, 4])
def test_the_error_of_held_out_views_is_that_of_a_calibration_without_them(seed: int):
    """Few views, which a lens made from them fits better than others: by how much, OpenCV calculates."""
    rng, folds = np.random.default_rng(seed), 4
    views = corner_views(rng, PINHOLE, 2 * folds, NOISE_PX)
    found = calibrate_camera(views, LensModel.RADIAL_TANGENTIAL)
    kept = found.fit.kept
    assert all(one.all() for one in kept)
    own = np.concatenate([
        pixels_of(found.fit.intrinsics, pose, view.points) - view.pixels
        for view, pose in zip(views, found.fit.poses, strict=True)
    ])  # fmt: skip
    assert math.sqrt(np.square(own).mean()) < NOISE_PX < 0.9 * found.held_out_px
    assert found.held_out_px == pytest.approx(held_out_by_opencv(views, folds), rel=2e-3)
    # The corners of one view in eight are off by 1 px.
    views[1] = replace(views[1], pixels=views[1].pixels + rng.normal(0.0, 1.0, views[1].pixels.shape))
    spoiled = held_out_error(views, found.fit, kept)
    assert spoiled == pytest.approx(held_out_by_opencv(views, folds), rel=2e-3)
    assert spoiled > 1.3 * found.held_out_px


def refused(views: list[BoardView], model: LensModel | None = LensModel.RADIAL_TANGENTIAL) -> str:
    return "; ".join(calibrate_camera(views, model).problems)


def missing(views: list[BoardView]) -> str:
    return "; ".join(coverage_of(views).missing)


@pytest.mark.slow
def test_sets_that_leave_something_out_are_refused_with_what_is_missing():
    rng = np.random.default_rng(4)
    whole = corner_views(rng, PINHOLE, 40, 0.1)
    assert refused(whole, None) == ""
    left = corner_views(rng, PINHOLE, 20, 0.1, inside=(0.0, 0.0, 0.55, 1.0))
    assert "nearer to the right edge" in refused(left)
    assert "show the board in the upper right corner of the image" in missing(left)
    low = corner_views(rng, PINHOLE, 20, 0.1, inside=(0.0, 0.4, 1.0, 1.0))
    assert "nearer to the upper edge" in missing(low)
    assert coverage_of(left).bars[0] < 1.0 and coverage_of(low).bars[1] < 1.0
    assert missing(diverse(whole, 8)).startswith("show 2 more views that differ")
    flat = [view for view in corner_views(rng, PINHOLE, 80, 0.1) if view.placement[3] < 0.25]
    assert "tilt the board" in missing(flat)
    far = [view for view in corner_views(rng, PINHOLE, 60, 0.1) if view.placement[2] < 0.36]
    assert "nearer to the camera" in missing(far)


def test_sets_that_cannot_be_right_are_refused():
    rng = np.random.default_rng(6)
    stretched = []
    for view in corner_views(rng, PINHOLE, 25, 0.1):
        # Printed 4 % too long.
        points = view.points / [1.0, 1.04, 1.0]
        stretched.append(replace(view, points=points))
    assert "printed at 100 %" in refused(stretched)
    shaken = corner_views(rng, PINHOLE, 25, 1.2)
    assert "of views held out are 1." in refused(shaken)
    uncertain = refused(corner_views(rng, PINHOLE, 15, 0.4))
    assert "projections are uncertain by" in uncertain and "more views there" in uncertain
    views = corner_views(rng, PINHOLE, 12, 0.1)
    few = refused(views[:3])
    assert "none of so few views can be held out: show the board at least 4 times" in few
    assert "inf" not in few and "is the board flat" not in few
    with pytest.raises(InvalidValue, match="2 views of the target; three are the least"):
        calibrate_camera(views[:2])
    with pytest.raises(InvalidValue, match="images of different sizes: 320x240, 640x480"):
        calibrate_camera([*views, replace(views[0], image_size=(320, 240))])


def test_placements_are_those_of_ros():
    """A board that faces the camera: its place, its share of the image, and no skew."""
    target = CalibrationTarget()
    width, height = (target.columns - 2) * target.square, (target.rows - 2) * target.square
    pinhole = np.array([500.0, 500.0, 319.5, 239.5, 0, 0, 0, 0, 0])
    pose = np.array([0, 0, 0, -target.size[0] / 2, -target.size[1] / 2, 0.6])
    placement = placement_of(target, SIZE, target.corners, pixels_of(pinhole, pose, target.corners))
    assert placement is not None
    size = 500.0 / 0.6 * math.sqrt(width * height / (640 * 480))
    assert placement == pytest.approx([0.5, 0.5, size, 0.0], abs=0.01)
    pose[3] = -319.5 / 500 * 0.6 - target.square
    placement = placement_of(target, SIZE, target.corners, pixels_of(pinhole, pose, target.corners))
    assert placement is not None and placement[0] == pytest.approx(0.0, abs=0.01)
