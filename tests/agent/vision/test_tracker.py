"""Tracks against images whose motion is known."""

import copy

import numpy as np
import pytest

from mapweave.agent.vision.tracker import Tracker
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from tests.quick import first_quick

CAMERA = Camera(320, 240, 277.0, 276.0, 158.0, 121.0, mount_height=0.3)
IDEAL = Lens(CAMERA)
PHOTOGRAPHS = ("camera", "brick", "coins", "page", "text")


def followed(image: np.ndarray, anchored: bool = True) -> Tracker:
    """A tracker on an image's features."""
    tracker = Tracker(IDEAL, anchored)
    tracker.track(image)
    features = Sift(IDEAL).extract(image)
    tracker.add(np.arange(len(features)), features.raw)
    return tracker


@pytest.mark.parametrize("name", PHOTOGRAPHS)
@pytest.mark.parametrize("shift", [(0.3, -0.45), (-2.6, 1.15), (5.25, 0.5)])
def test_a_shift_is_followed_below_a_pixel(pictures, name, shift):
    image = pictures.photograph(name)
    tracker = followed(image)
    start, count = tracker.raw.copy(), len(tracker.ids)
    motion = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]])
    tracker.track(pictures.warped(image, motion, noise=1.0))
    error = np.linalg.norm(tracker.raw - start[tracker.ids] - shift, axis=1)
    assert np.median(error) < 0.15
    assert np.mean(error < 1.0) > 0.9
    assert len(tracker.ids) > 0.7 * count


def approach(step: float) -> np.ndarray:
    """The homography of a slanted wall that a robot drives to, in frames since the first."""
    grown = 1 + 0.006 * step
    return np.array([
        [grown, 0.0008 * step, -160 * (grown - 1) + 0.7 * step],
        [-0.0008 * step, grown, -120 * (grown - 1)],
        [4e-6 * step, 0, 1],
    ])  # fmt: skip


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_a_drive_is_followed_over_many_frames(pictures, name):
    """The image of a wall grows and tilts frame by frame; errors add up as chance does, and no faster."""
    image = pictures.photograph(name)
    tracker = followed(image)
    start, count = tracker.raw.copy(), len(tracker.ids)
    for step in range(1, 11):
        motion = approach(step)
        tracker.track(pictures.warped(image, motion, noise=0.7))
        error = np.linalg.norm(tracker.raw - pictures.mapped(motion, start[tracker.ids]), axis=1)
        assert np.median(error) < 0.15 * np.sqrt(step)
    inside = CAMERA.contains(pictures.mapped(motion, start), 6.0).sum()
    assert inside * 0.7 < len(tracker.ids) <= count


def test_a_far_jump_is_followed_where_it_is_expected(pictures):
    image = pictures.photograph("camera")
    motion = np.array([[1, 0, 60.0], [0, 1, -12.0], [0, 0, 1.0]])
    moved = pictures.warped(image, motion)

    def right(expect: bool) -> int:
        tracker = followed(image)
        start = tracker.raw.copy()
        # A robot's expectation is not exact, and of some tracks it has none.
        expected = pictures.mapped(motion, start) + np.random.default_rng(2).normal(0, 1.5, start.shape)
        expected[::7] = np.nan
        tracker.track(moved, expected if expect else None)
        known = tracker.ids % 7 != 0
        error = np.linalg.norm(tracker.raw - pictures.mapped(motion, start[tracker.ids]), axis=1)
        assert not expect or np.median(error[known]) < 0.15
        return int((error < 1).sum())

    assert right(expect=True) > 2 * right(expect=False)


def test_points_that_leave_the_image_are_dropped_and_named(pictures):
    image = pictures.photograph("camera")
    tracker = followed(image)
    start, ids = tracker.raw.copy(), tracker.ids.copy()
    motion = np.array([[1, 0, 40.0], [0, 1, 0], [0, 0, 1.0]])
    shifted = np.full_like(image, 100)
    shifted[:, 40:] = image[:, :-40]
    lost = tracker.track(shifted, pictures.mapped(motion, start))
    assert sorted([*lost, *tracker.ids]) == sorted(ids)
    gone = ids[start[:, 0] > 320 - 40]
    assert len(gone) > 5
    assert np.isin(gone, lost).all()
    assert CAMERA.contains(tracker.raw, 3.0).all()
    assert np.linalg.norm(tracker.raw - start[tracker.ids] - [40, 0], axis=1).max() < 1.0


@pytest.mark.parametrize("cover", ["blank", "other"])
def test_points_that_are_hidden_are_dropped(pictures, cover):
    image = pictures.photograph("camera")
    tracker = followed(image)
    start = tracker.raw.copy()
    hidden = image.copy()
    hidden[60:200, 80:240] = 90 if cover == "blank" else pictures.photograph("brick")[60:200, 80:240]
    tracker.track(hidden)
    inside = (start > [88, 68]).all(axis=1) & (start < [232, 192]).all(axis=1)
    outside = (start < [68, 48]).any(axis=1) | (start > [252, 212]).any(axis=1)
    assert inside.sum() > 15
    assert np.isin(np.flatnonzero(inside), tracker.ids).mean() < 0.1
    assert np.isin(np.flatnonzero(outside), tracker.ids).mean() > 0.95


def test_a_camera_that_changes_its_size_loses_everything(pictures):
    tracker = followed(pictures.photograph("camera"))
    ids = tracker.ids.copy()
    assert np.array_equal(tracker.track(np.zeros((120, 160), np.uint8)), ids)
    assert len(tracker.ids) == len(tracker.raw) == 0


def test_points_are_added_kept_and_forgotten(pictures):
    tracker = Tracker(IDEAL)
    assert len(tracker.track(pictures.photograph("camera"))) == 0
    tracker.add(np.array([5, 9, 7]), np.array([[50.0, 60.0], [70.0, 80.0], [90.0, 100.0]]))
    tracker.keep(tracker.ids != 9)
    assert tracker.ids.tolist() == [5, 7]
    assert tracker.raw.tolist() == [[50.0, 60.0], [90.0, 100.0]]
    assert np.array_equal(tracker.pixels, tracker.raw)
    tracker.clear()
    assert len(tracker.ids) == 0


@pytest.mark.parametrize("name", first_quick(PHOTOGRAPHS, 2))
def test_errors_do_not_add_up(pictures, name):
    """Approach by a third and retreat: what frame to frame tracking gathers, the first patch undoes."""
    image = pictures.photograph(name)
    there = [approach(step) for step in (*range(0, 56, 2), *range(56, -1, -2))]

    def error(anchored: bool) -> tuple[float, float]:
        tracker = followed(image, anchored)
        start, worst = tracker.raw.copy(), 0.0
        for number, motion in enumerate(there):
            grain = np.random.default_rng(number).normal(0, 1.0, image.shape)
            seen = pictures.warped(image, motion) + grain
            tracker.track(np.clip(seen, 0, 255).round().astype(np.uint8))
            away = np.linalg.norm(tracker.raw - pictures.mapped(motion, start[tracker.ids]), axis=1)
            worst = max(worst, float(np.median(away)))
        return float(np.median(away)), worst

    (end, worst), (drifted, drifted_worst) = error(anchored=True), error(anchored=False)
    assert end < max(0.06, drifted)
    assert worst < 0.6 * drifted_worst


def test_age_and_hold_are_returned(pictures):
    image = pictures.photograph("camera")
    tracker = followed(image)
    assert not tracker.ages.any()
    first = len(tracker.ids)
    for _ in range(3):
        tracker.track(image)
    tracker.add(np.array([1000]), np.array([[100.0, 100.0]]))
    tracker.track(image)
    assert set(tracker.ages[tracker.ids < first]) == {4}
    assert set(tracker.ages[tracker.ids == 1000]) <= {1}
    # Patches that reach beyond the border cannot be compared; all others can, and nothing has changed.
    inner = (np.abs(tracker.raw - [159.5, 119.5]) < [150, 110]).all(axis=1)
    assert inner.sum() > 40
    assert tracker.held[inner].all()
    lone = followed(image, anchored=False)
    lone.track(image)
    assert not lone.held.any()


def test_a_point_needs_an_image():
    with pytest.raises(InvalidValue, match="track one first"):
        Tracker(IDEAL).add(np.array([1]), np.array([[50.0, 50.0]]))


def test_another_light_loses_no_point(pictures):
    """The lamp goes off between two images; the caller knows, and shows the last image as it would be now."""
    image = pictures.photograph("camera")
    dark = (0.45 * image + 5).round().astype(np.uint8)
    tracker = followed(image)
    count, start = len(tracker.ids), tracker.raw.copy()
    tracker.relight(dark)
    motion = np.array([[1, 0, 2.3], [0, 1, -1.2], [0, 0, 1.0]])
    tracker.track(pictures.warped(dark, motion))
    assert len(tracker.ids) > 0.8 * count
    away = np.linalg.norm(tracker.raw - start[tracker.ids] - [2.3, -1.2], axis=1)
    assert np.median(away) < 0.1
    assert tracker.held.mean() > 0.8, "a patch is the same in another light"


def test_a_copy_goes_its_own_way(pictures):
    """A caller that may reject an image tracks a copy into it, which it can drop."""
    image = pictures.photograph("coins")
    tracker = followed(image)
    before = [column.copy() for column in (tracker.ids, tracker.raw, tracker.ages, tracker.held)]
    trial = copy.copy(tracker)
    trial.track(pictures.photograph("brick"))
    for column, was in zip((tracker.ids, tracker.raw, tracker.ages, tracker.held), before, strict=True):
        assert np.array_equal(column, was)
    moved = pictures.warped(image, approach(2))
    fresh = followed(image)
    tracker.track(moved)
    fresh.track(moved)
    assert np.array_equal(tracker.raw, fresh.raw), "to the last bit"
