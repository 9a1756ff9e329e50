"""Sensors fail or lie in a recorded run: the filter names the cause, doubts as it should, recovers."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapweave import Odometry, Pose2
from mapweave.agent.ekf import pixel_noise
from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.ekf.update_report import Health
from mapweave.agent.settings import FilterSettings
from synthetic.mapping_run import AXLE, SHAPES, WHEEL_NOISE, MappingRun, draw_run
from tests.quick import first_quick

FIRST, LAST, END = 150, 170, 300
"""The fault lasts from one step to the other; the run goes on until the end."""

CHI2_3 = 21.1
"""Squared Mahalanobis distance that a right filter exceeds once in ten thousand."""

Fault = Callable[[MappingRun, int], tuple[Odometry, np.ndarray | None]]


def recorded(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    return run.odometry[k], run.pixels[k + 1]


def dropped_frames(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    return run.odometry[k], None


def blocked_lens(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    return run.odometry[k], np.full_like(run.pixels[k + 1], np.nan)


def one_landmark(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    pixels = np.full_like(run.pixels[k + 1], np.nan)
    middle = int(np.nanargmin(np.abs(run.pixels[k + 1, :, 0] - run.camera.cx)))
    pixels[middle] = run.pixels[k + 1, middle]
    return run.odometry[k], pixels


def silent_encoders(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    return Odometry(0.0, 0.0), run.pixels[k + 1]


def spiking_encoder(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    spike = 0.25 if k % 3 == 0 else 0.0
    return Odometry(run.odometry[k].forward, run.odometry[k].turn + spike), run.pixels[k + 1]


def scrambled(run: MappingRun, k: int) -> tuple[Odometry, np.ndarray | None]:
    """The tracker has lost its wits: each track is somewhere."""
    rng = np.random.default_rng(k)
    return run.odometry[k], rng.uniform((0, 0), (320, 240), run.pixels[k + 1].shape)


def drive(run: MappingRun, fault: Fault) -> tuple[MappingFilter, list[Health], list[float], list[float]]:
    """Health, trace of the pose's covariance, and squared distance from the truth after each step."""
    filter_ = MappingFilter(run.camera, AXLE, WHEEL_NOISE, FilterSettings(pixel_sigma=run.pixel_sigma))
    ids = np.arange(len(run.points))
    filter_.add(ids, run.pixels[0])
    health, traces, distances = [], [], []
    for k in range(END):
        odometry, pixels = (fault if FIRST <= k < LAST else recorded)(run, k)
        filter_.predict(odometry)
        if pixels is not None:
            report = filter_.update(ids, pixels)
            assert (report.reason == "") == (report.health is Health.GOOD)
        text, why = filter_.health
        assert (why == "") == (text is Health.GOOD)
        health.append(text)
        traces.append(float(np.trace(filter_.pose.covariance)))
        distances.append(filter_.pose.mahalanobis2(run.poses[k + 1]))
    return filter_, health, traces, distances


@cache
def drawn(k: int) -> MappingRun:
    return draw_run(np.random.default_rng([21, k]), SHAPES[k], END)


@pytest.fixture(params=first_quick(range(3), 1))
def number(request: pytest.FixtureRequest) -> int:
    """Of a run."""
    return int(request.param)


@pytest.fixture
def run(number: int) -> MappingRun:
    return drawn(number)


@cache
def undisturbed(number: int) -> MappingFilter:
    """The filter after a run in which nothing fails."""
    return drive(drawn(number), recorded)[0]


@pytest.mark.parametrize(("fault", "named", "share", "growth"), [
    (dropped_frames, Health.NO_IMAGE, 0.9, 1.5),
    (blocked_lens, Health.BLIND, 1.0, 1.5),
    (one_landmark, Health.FEW, 1.0, 1.2),
    (scrambled, Health.DISAGREEMENT, 0.9, 1.5),
])  # fmt: skip
def test_without_landmarks_the_uncertainty_grows_and_is_reported(
    number: int, run: MappingRun, fault: Fault, named: Health, share: float, growth: float
):
    filter_, health, traces, distances = drive(run, fault)
    during = health[FIRST:LAST]
    assert during.count(named) >= share * len(during)
    assert named not in health[:FIRST] + health[LAST:]
    assert traces[LAST - 1] > growth * traces[FIRST - 1]
    assert max(distances) < CHI2_3
    # Seeing again, it is as sure as a filter that was never blind would be, and as right.
    whole = undisturbed(number)
    assert np.trace(filter_.pose.covariance) < 3.0 * np.trace(whole.pose.covariance)
    assert health[-50:].count(Health.GOOD) >= 45


@pytest.mark.parametrize("fault", [silent_encoders, spiking_encoder])
def test_wheels_that_lie_are_named_and_the_image_holds_the_pose(run: MappingRun, fault: Fault):
    filter_, health, _, distances = drive(run, fault)
    lies = [
        k
        for k in range(FIRST, LAST)
        if abs(fault(run, k)[0].turn - run.odometry[k].turn) > 0.005
    ]  # fmt: skip
    collected = [k for k in lies if health[k] is Health.SLIP]
    assert len(collected) >= 0.8 * len(lies)
    # A wheel may really slip at any time, but seldom does.
    assert sum(lines is Health.SLIP for lines in health[:FIRST]) <= 6
    assert max(distances) < CHI2_3
    off = filter_.pose.mean.inverse() @ run.poses[END]
    assert np.hypot(off.x, off.y) < 0.03
    assert abs(off.heading) < 0.01


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_standing_or_turning_is_reported_until_the_robot_drives(turn: float):
    run = draw_run(np.random.default_rng(5), "line", 100)
    filter_ = MappingFilter(run.camera, AXLE, WHEEL_NOISE, FilterSettings(pixel_sigma=run.pixel_sigma))
    ids, rng = np.arange(30), np.random.default_rng(6)
    filter_.add(ids, run.pixels[0])
    for k in range(40):
        step = turn if k % 2 == 0 else -turn
        heading = step if k % 2 == 0 else 0.0
        seen = run.camera.project(Pose2(0, 0, heading).inverse().apply(run.points))
        filter_.predict(Odometry(0.0, step))
        filter_.update(ids, seen + run.pixel_sigma * rng.normal(size=seen.shape))
        text, why = filter_.health
        assert text is Health.NO_PARALLAX
        assert "depths" in why
    for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
        filter_.predict(odometry)
        filter_.update(ids, pixels)
    assert filter_.health == (Health.GOOD, "")


def test_a_blind_filter_is_lost_slowly_and_found_again():
    """Six seconds without an image on a drive that turns: the wheels alone, then landmarks again."""
    run = draw_run(np.random.default_rng(9), "weave", END)
    blind = replace(run, pixels=run.pixels.copy())
    blind.pixels[100:160] = np.nan
    filter_, _, traces, distances = drive(blind, recorded)
    assert traces[158] > 5 * traces[98]
    assert traces[-1] < traces[158] / 3
    assert max(distances) < CHI2_3
    assert filter_.converged().mean() > 0.5


@pytest.mark.slow
def test_pixels_worse_than_nominal_are_detected(monkeypatch):
    """The image is blurred: pixels err three times as much as the tracker knows."""
    apart = []
    for seed in range(8):
        run = draw_run(np.random.default_rng([31, seed]), SHAPES[seed % 4], END, pixel_sigma=2.1)
        run = replace(run, pixel_sigma=0.7)
        _, health, _, distances = drive(run, recorded)
        plain = MappingFilter(run.camera, AXLE, WHEEL_NOISE)
        plain.add(np.arange(30), run.pixels[0])
        with monkeypatch.context() as unlearned:
            unlearned.setattr(pixel_noise, "ADAPTATION", 0.0)
            for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
                plain.predict(odometry)
                plain.update(np.arange(30), pixels)
        apart.append((distances[-1], plain.pose.mahalanobis2(run.poses[END])))
        assert health[100:].count(Health.DISAGREEMENT) == 0
    own, without = np.mean(apart, axis=0)
    # What was learned in the first second, before the noise was known, stays too sure of itself.
    assert own < 25.0
    assert own < 0.4 * without, (own, without)
