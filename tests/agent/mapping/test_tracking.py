"""Tracks and filter together: what is reported, and that the filter does not run dry."""

from dataclasses import replace

import numpy as np

from mapweave import Observation, Odometry, Pose2
from mapweave.agent.mapping.anchored_keyframe import HERE
from mapweave.agent.mapping.tracking import Tracking
from mapweave.agent.settings import AgentSettings, TrackingSettings
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

LEFT = 0.06
"""rad a tick."""


def begun(walls, description, settings: TrackingSettings | None = None) -> Tracking:
    """Tracking that has begun at the origin."""
    lens = Lens(description.camera, description.distortion)
    tracking = Tracking(description, lens, AgentSettings(tracking=settings or TrackingSettings()))
    first = Observation(0, Odometry(0.0, 0.0), walls.render(Pose2()))
    tracking.step(first)
    tracking.follow(tracking.take(first, Sift(lens).extract(walls.render(Pose2())), HERE))
    tracking.fill(2.5)
    return tracking


def test_the_report_follows_the_tracks(walls, description):
    tracking = begun(walls, description)
    start = tracking.report
    assert (start.alive, start.age_median) == (len(tracking.ids), 0)
    assert np.isnan(start.error_px_median), "nothing was expected yet"
    pose = Pose2()
    for tick in range(1, 13):
        before, pose = pose, Pose2(0.025 * tick)
        tracking.step(walls.observe(before, pose, tick))
    report = tracking.report
    assert report.alive == len(tracking.ids)
    assert report.age_median == 12
    assert 0.0 < report.error_px_median < 1.5
    cells = {(int(x // 80), int(y // 60)) for x, y in tracking.pixels}
    assert report.coverage == len(cells) / 16


def test_a_missing_image_leaves_the_report(walls, description):
    tracking = begun(walls, description)
    tracking.step(walls.observe(Pose2(), Pose2(0.02), 1))
    report = tracking.report
    tracking.step(Observation(2, Odometry(0.02, 0.0), None))
    assert tracking.report == report


def test_the_filter_takes_further_tracks_when_its_own_are_left_behind(walls, description, monkeypatch):
    """The robot turns away from what it chose first; tracks that it did not choose are still in view."""
    monkeypatch.setattr("mapweave.agent.mapping.tracking.REFILL_SHARE", 8 / 12)
    tracking = begun(walls, description, TrackingSettings(filtered=12))
    own, pose = set(tracking.landmarks().ids.tolist()), Pose2()
    assert len(own) == 12
    for tick in range(1, 13):
        before, pose = pose, Pose2(0.0, 0.0, LEFT * tick)
        tracking.step(walls.observe(before, pose, tick))
    now = tracking.landmarks().ids
    left = own & set(tracking.ids.tolist())
    assert len(left) < 8 < len(tracking.ids), "a turn that leaves some"
    assert len(now) >= 8
    assert len(set(now.tolist()) - set(tracking.ids.tolist())) <= 1, "what is behind a corner may wait"
    assert abs(tracking.pose.mean.heading - LEFT * 12) < 0.005


def test_further_tracks_hold_the_heading_when_wheels_lie(walls, description, monkeypatch):
    """Wheels that turn a tenth too far are corrected as long as anything is in view."""

    def error(refill: float) -> float:
        monkeypatch.setattr("mapweave.agent.mapping.tracking.REFILL_SHARE", refill)
        settings = TrackingSettings(filtered=12)
        tracking, pose = begun(walls, description, settings), Pose2()
        for tick in range(1, 14):
            before, pose = pose, Pose2(0.0, 0.0, LEFT * tick)
            observed = walls.observe(before, pose, tick)
            tracking.step(replace(observed, odometry=Odometry(0.0, 1.1 * LEFT)))
        return abs(tracking.pose.mean.heading - pose.heading)

    assert error(refill=8 / 12) < 0.6 * error(refill=0.0)


def test_tracks_that_do_not_correct_the_filter_are_expected_where_they_were_last(
    walls, description, monkeypatch
):
    """Few tracks in one corner: only wheels are trusted, they drift, and the robot was not carried off.

    A robot before a bare wall once took itself for carried off when its filter was 20 px off its tracks.
    """
    monkeypatch.setattr("mapweave.agent.mapping.tracking.LEAST_SPREAD", 1.5)
    tracking, pose = begun(walls, description), Pose2()
    alive = len(tracking.ids)
    for tick in range(1, 21):
        before, pose = pose, Pose2(0.002 * tick)
        observed = walls.observe(before, pose, tick)
        tracking.step(replace(observed, odometry=Odometry(observed.odometry.forward, 0.01)))
        assert tracking.acceptance.strange == tracking.acceptance.blank == 0
    assert abs(tracking.pose.mean.heading - 0.2) < 1e-6, "by the wheels alone"
    assert len(tracking.ids) > 0.9 * alive


def past(image: np.ndarray, tick: int) -> np.ndarray:
    """A person with a striped coat walks through the view, as wide as a third of it."""
    left = 16 * tick - 110
    shown = image.copy()
    columns = np.arange(max(left, 0), min(left + 110, image.shape[1]))
    shown[:, columns] = 90 + 60 * ((columns - left) // 7 % 2)[None, :]
    return shown


def test_landmarks_occluded_by_a_person_are_found_again(walls, description):
    tracking, pose = begun(walls, description), Pose2()
    for tick in range(1, 12):
        before, pose = pose, Pose2(0.02 * tick)
        tracking.step(walls.observe(before, pose, tick))
    ids = set(tracking.landmarks().ids.tolist())
    fewest = len(ids)
    for tick in range(12, 44):
        before, pose = pose, Pose2(0.22 - 0.01 * (tick - 11))
        seen = walls.observe(before, pose, tick)
        tracking.step(replace(seen, image=past(seen.image, tick - 11)))
        fewest = min(fewest, len(ids & set(tracking.ids.tolist())))
    assert fewest < 0.75 * len(ids), "a person was in the way"
    back = ids & set(tracking.ids.tolist())
    assert len(back) >= 0.8 * len(ids)
    off = tracking.pose.mean.inverse() @ pose
    assert np.hypot(off.x, off.y) < 0.01
    assert abs(off.heading) < 0.003
    # What is found again is where it should be.
    expected = {
        int(i): p for i, p in zip(tracking.landmarks().ids, tracking._filter.predict_pixels(), strict=True)
    }
    at = dict(zip(tracking.ids.tolist(), tracking.pixels, strict=True))
    assert max(np.linalg.norm(at[i] - expected[i]) for i in back) < 2.0


def test_landmarks_that_do_not_come_back_are_given_up(walls, description):
    """A poster is hung over them for good: nothing there is taken for what was behind it."""
    tracking, pose = begun(walls, description), Pose2()
    for tick in range(1, 12):
        before, pose = pose, Pose2(0.02 * tick)
        tracking.step(walls.observe(before, pose, tick))
    middle = np.abs(tracking.pixels[:, 0] - 160) < 40
    covered = set(tracking.ids[middle].tolist()) & set(tracking.landmarks().ids.tolist())
    assert covered
    poster = np.random.default_rng(0).integers(0, 255, (240, 120)).astype(np.uint8)
    for tick in range(12, 12 + 75):
        seen = walls.observe(pose, pose, tick)
        image = seen.image.copy()
        image[:, 100:220] = poster
        tracking.step(replace(seen, image=image))
    assert not covered & set(tracking.ids.tolist())
    assert not covered & set(tracking.landmarks().ids.tolist())
