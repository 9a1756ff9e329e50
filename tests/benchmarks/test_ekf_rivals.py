"""The mapping filter and FilterPy's come to the same where the algorithm is the same."""

import numpy as np
import pytest

from benchmarks.ekf_speed import benchmark as ekf_speed
from benchmarks.ekf_speed.benchmark import Ours, Theirs, gap, race, textbook
from mapweave.hybridmap.camera import Camera
from synthetic.mapping_run import AXLE, SHAPES, WHEEL_NOISE, draw_run
from tests.quick import first_quick

AHEAD = Camera(320, 240, 277.0, 277.0, 160.0, 120.0, mount_height=0.3, mount_forward=0.08)


@pytest.mark.parametrize("shape", first_quick(SHAPES, 1))
def test_same_estimates_over_a_whole_run(shape: str):
    """State and covariance to 1e-6 at each of 500 steps, landmarks coming into view and leaving it."""
    run = draw_run(np.random.default_rng([21, SHAPES.index(shape)]), shape, landmarks=12, camera=AHEAD)
    assert np.isnan(run.pixels).any()
    own, theirs = Ours(run, plain=True), Theirs(run)
    with textbook():
        for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
            own.step(odometry, pixels)
            theirs.step(odometry, pixels)
            assert max(gap(own.belief, theirs.belief)) < 1e-6


def test_a_wrong_model_does_not_agree(monkeypatch):
    """What the agreement is worth: wheels of twice the noise are noticed."""
    run = draw_run(np.random.default_rng(22), "arc", steps=20, landmarks=12)
    own = Ours(run, plain=True)
    monkeypatch.setattr(ekf_speed, "WHEEL_NOISE", 2 * WHEEL_NOISE)
    theirs = Theirs(run)
    with textbook():
        for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
            own.step(odometry, pixels)
            theirs.step(odometry, pixels)
    assert min(gap(own.belief, theirs.belief)) > 1e-5


def test_a_race_goes_on_when_our_filter_gives_a_landmark_up():
    """With its rules it does so in this run, at step 72."""
    run = draw_run(np.random.default_rng(8932), "arc", steps=200, landmarks=30)
    own = Ours(run)
    for odometry, pixels in zip(run.odometry[:72], run.pixels[1:], strict=False):
        own.step(odometry, pixels)
    assert len(own.belief[0]) == 3 + 3 * 29
    assert race(8932, 30).difference < 1e-6


def test_transition_is_the_motions_derivative():
    """FilterPy's dense F against central differences of its own motion."""
    run = draw_run(np.random.default_rng(23), "arc", steps=20, landmarks=5, camera=AHEAD)
    step = run.odometry[-1]
    # Here, since it takes half a second to import.
    from benchmarks.ekf_speed.filterpy_filter import FilterPyMapping

    filter_ = FilterPyMapping(run.camera, AXLE, WHEEL_NOISE, run.pixels[0], 0.7, 2.5, 1.2)
    at = filter_.x.copy()
    filter_.move(step)
    columns = []
    for i in range(len(at)):
        ends = []
        for way in (1e-6, -1e-6):
            filter_.x = at + way * np.eye(len(at))[i]
            filter_.predict_x(step)
            ends.append(filter_.x)
        columns.append((ends[0] - ends[1]) / 2e-6)
    assert np.abs(np.column_stack(columns) - filter_.F).max() < 1e-8


def test_the_race_measures_all_three():
    speed = race(24, 8, steps=15)
    assert min(speed.full_ms, speed.plain_ms, speed.filterpy_ms) > 0.0
    assert 0.0 < speed.difference < 1e-6
    assert 0.0 < speed.covariance_difference < 1e-6
