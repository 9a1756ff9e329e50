"""Patches found again, against brute force, finite differences and warps that are known."""

import numpy as np
import pytest

from mapweave.agent.vision.template import HALF_PX, SIGMA_PX, TemplateCriteria, TemplateMatcher
from tests.quick import first_quick

SPOTS = np.array([[x + 0.37, y - 0.21] for x in range(60, 280, 40) for y in range(50, 200, 35)])


def bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey levels between pixels, with NumPy alone."""
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - left, y - top
    image = image.astype(float)
    upper = (1 - u) * image[top, left] + u * image[top, left + 1]
    lower = (1 - u) * image[top + 1, left] + u * image[top + 1, left + 1]
    return (1 - v) * upper + v * lower


def patches(image: np.ndarray, at: np.ndarray, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A patch of mean 0 and deviation 1, and its weights, as the product's."""
    side = np.arange(-HALF_PX, HALF_PX + 1.0)
    x, y = (grid.ravel() for grid in np.meshgrid(side, side))
    weights = np.exp(-(x**2 + y**2) / (2 * SIGMA_PX**2))
    weights /= weights.sum()
    patch = bilinear(image, at[0] + scale * x, at[1] + scale * y)
    patch = patch - weights @ patch
    return patch / np.sqrt(weights @ patch**2), weights


def textured(image: np.ndarray) -> np.ndarray:
    """(N, 2) px: of a dense grid, the spots around which an image is not bare."""
    grid = [np.array([x + 0.37, y - 0.21]) for x in range(50, 280, 20) for y in range(40, 200, 20)]
    spots = [at for at in grid if image[round(at[1]) - 5 :, round(at[0]) - 5 :][:11, :11].std() > 20]
    assert len(spots) > 12
    return np.array(spots)


def zoomed(pictures, image: np.ndarray, scale: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """An image grown about its middle and moved a little, and the homography."""
    middle = np.array([159.5, 119.5])
    shift = middle - scale * middle + [1.4, -0.8]
    motion = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1.0]])
    return pictures.warped(image, motion, noise), motion


@pytest.mark.parametrize("name", ["camera", "coins", "page"])
def test_slopes_are_those_of_finite_differences(pictures, name):
    image = pictures.photograph(name)
    spots = textured(image)
    templates = TemplateMatcher().cut(image, spots)
    for number, at in enumerate(spots):
        patch, weights = patches(image, at)
        assert np.allclose(templates.patches[number], patch, atol=1e-3)
        h = 0.5
        expected = [
            (patches(image, at + step)[0] - patches(image, at - step)[0]) / (2 * h)
            for step in (np.array([h, 0]), np.array([0, h]))
        ]
        result = templates.slopes[number] / weights
        for k, wanted in enumerate(expected):
            # Half a pixel is no small step: contrast changes a little over it, which slopes leave out.
            assert np.corrcoef(result[k], wanted)[0, 1] > 0.97
            assert np.linalg.norm(result[k]) == pytest.approx(np.linalg.norm(wanted), rel=0.15)
        grown = (patches(image, at, 1.05)[0] - patches(image, at, 0.95)[0]) / 0.1
        assert np.corrcoef(result[2], grown)[0, 1] > 0.9
        assert np.abs(result @ (weights * patch)).max() < 2e-3, "contrast changes nothing"
        assert np.abs(result @ weights).max() < 2e-3, "nor does brightness"


@pytest.mark.parametrize("name", first_quick(["camera", "coins", "page"], 1))
def test_a_match_is_the_best_there_is(pictures, name):
    """Against a search through all shifts and sizes near by, which knows no derivatives."""
    image = pictures.photograph(name)
    seen, motion = zoomed(pictures, image, 1.06)
    spots = textured(image)[::3]
    guess = pictures.mapped(motion, spots) + np.random.default_rng(4).uniform(-0.5, 0.5, spots.shape)
    # More steps than on a robot, where the next image corrects what is left of this one.
    matcher = TemplateMatcher(TemplateCriteria(iterations=8))
    match = matcher.match(matcher.cut(image, spots), seen, guess)
    steps, growths = np.arange(-0.2, 0.21, 0.05), (0.97, 0.985, 1.0, 1.015, 1.03)
    checked = 0
    for spot, at, scale in zip(
        spots[match.held], match.raw[match.held], match.templates.scales[match.held], strict=True
    ):
        wanted, weights = patches(image, spot)
        alike = [
            (weights * wanted) @ patches(seen, at + np.array([dx, dy]), scale * growth)[0]
            for dx in steps for dy in steps for growth in growths
        ]  # fmt: skip
        result = (weights * wanted) @ patches(seen, at, scale)[0]
        # Along an edge the optimum is flat, and Gauss and Newton's model of it is not exact.
        assert max(alike) - result < 0.004
        checked += 1
    assert checked >= 4


@pytest.mark.parametrize("light", [(1.0, 0.0), (0.6, 30.0), (1.2, -20.0)])
@pytest.mark.parametrize("scale", [0.8, 1.0, 1.25])
def test_growth_and_light_are_seen_through(pictures, scale, light):
    image = pictures.photograph("camera")
    seen, motion = zoomed(pictures, image, scale)
    seen = np.clip(light[0] * (seen.astype(float) - 128) + 128 + light[1], 0, 255).round().astype(np.uint8)
    true = pictures.mapped(motion, SPOTS)
    matcher = TemplateMatcher()
    templates = matcher.cut(image, SPOTS)
    # Sizes change little from image to image: the last one was nearly as large.
    near = type(templates)(*templates.columns[:3], np.full(len(SPOTS), 1 + 0.9 * (scale - 1), np.float32))
    match = matcher.match(near, seen, true + np.random.default_rng(1).uniform(-0.4, 0.4, true.shape))
    assert match.held.mean() > 0.6
    away = np.linalg.norm(match.raw - true, axis=1)[match.held]
    assert np.median(away) < 0.09
    assert np.median(np.abs(match.templates.scales[match.held] - scale)) < 0.02


def test_different_patches_are_not_held(pictures):
    image, other = pictures.photograph("camera"), pictures.photograph("brick")
    matcher = TemplateMatcher()
    templates = matcher.cut(image, SPOTS)
    for wrong in (other, np.full_like(image, 90), 255 - image):
        match = matcher.match(templates, wrong, SPOTS)
        assert match.held.mean() < 0.05
        assert np.array_equal(match.raw[~match.held], SPOTS[~match.held]), "the track stays what it was"
    far = matcher.match(templates, image, SPOTS + 4.0)
    assert not (np.linalg.norm(far.raw - SPOTS, axis=1) < 1.0).any(), "nothing is pulled from far away"


def test_a_blank_patch_is_harmless():
    blank = np.full((240, 320), 100, np.uint8)
    matcher = TemplateMatcher()
    match = matcher.match(matcher.cut(blank, SPOTS), blank, SPOTS)
    assert not match.held.any()
    assert np.array_equal(match.raw, SPOTS)


def test_patches_at_the_border_are_left_alone(pictures):
    image = pictures.photograph("camera")
    at = np.array([[5.0, 100.0], [316.0, 100.0], [100.0, 6.0], [100.0, 234.0]])
    matcher = TemplateMatcher()
    match = matcher.match(matcher.cut(image, at), image, at)
    assert not match.held.any()
    assert np.array_equal(match.raw, at)


def test_a_patch_that_has_grown_too_much_is_cut_again(pictures):
    image = pictures.photograph("camera")
    matcher = TemplateMatcher()
    spots = 159.5 + np.array([[-20.0, -60], [10, -45], [15, -20], [-10, -35], [25, -60], [-30, -40]])
    templates, at, motions, renewed = matcher.cut(image, spots), spots, [], np.zeros(len(spots), bool)
    was = motion = np.eye(3)
    for scale in np.arange(1.0, 2.2, 0.04):
        seen, motion = zoomed(pictures, image, float(scale))
        motions.append(motion)
        guess = pictures.mapped(motion @ np.linalg.inv(was), at)
        before, was = templates.scales, motion
        match = matcher.match(templates, seen, guess)
        at, templates = match.raw, match.templates
        renewed |= match.held & (before > 1.5) & (templates.scales == 1.0)
    assert renewed.any()
    good = match.held & renewed
    assert good.any()
    assert np.median(np.linalg.norm(at - pictures.mapped(motion, spots), axis=1)[good]) < 0.4


def test_matching_changes_nothing_and_repeats_itself(pictures):
    image = pictures.photograph("coins")
    seen, _ = zoomed(pictures, image, 1.03, noise=2.0)
    matcher = TemplateMatcher()
    templates = matcher.cut(image, SPOTS)
    were = [column.copy() for column in templates.columns]
    first, second = (matcher.match(templates, seen, SPOTS) for _ in range(2))
    assert np.array_equal(first.raw, second.raw)
    assert np.array_equal(first.templates.scales, second.templates.scales)
    assert all(np.array_equal(a, b) for a, b in zip(templates.columns, were, strict=True))


def test_patches_are_chosen_joined_and_few(pictures):
    image = pictures.photograph("coins")
    matcher = TemplateMatcher()
    templates = matcher.cut(image, SPOTS)
    odd = np.arange(len(SPOTS)) % 2 == 1
    both = templates.chosen(odd).joined(templates.chosen(~odd))
    order = np.argsort(np.concatenate([np.flatnonzero(odd), np.flatnonzero(~odd)]))
    for column, whole in zip(both.columns, templates.columns, strict=True):
        assert np.array_equal(column[order], whole)
    none = matcher.none()
    assert len(none) == 0
    assert len(none.joined(templates)) == len(SPOTS)
    assert matcher.match(none, image, np.zeros((0, 2))).raw.shape == (0, 2)
