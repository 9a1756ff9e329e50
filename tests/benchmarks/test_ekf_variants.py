"""The comparison of linearisations: its filters do what their names say."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest

from benchmarks.ekf_speed.benchmark import Ours, gap, plain
from benchmarks.ekf_variants.benchmark import OURS, TEXTBOOK, Outcome, main, summary, try_textbook
from benchmarks.ekf_variants.coordinates import (
    Coordinates,
    Points,
    Rays,
    from_pose,
    in_robot,
    jacobian,
    of_robot,
)
from benchmarks.ekf_variants.textbook import Choice, TextbookFilter
from mapweave.agent.settings import FilterSettings
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from synthetic.mapping_run import MappingRun, draw_run

AHEAD = Camera(320, 240, 277.0, 277.0, 160.0, 120.0, mount_height=0.3, mount_forward=0.08)
CHARTS = [Points(), Rays()]


def short_run(seed: int, steps: int = 60) -> MappingRun:
    return draw_run(np.random.default_rng(seed), "weave", steps=steps, landmarks=8, camera=AHEAD)


def followed(run: MappingRun, choice: Choice) -> TextbookFilter:
    filter_ = TextbookFilter(run, choice)
    for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
        filter_.step(odometry, pixels)
    return filter_


@pytest.mark.parametrize("chart", CHARTS)
def test_a_moved_camera_agrees_with_the_camera_model(chart: Coordinates) -> None:
    """Charts and motion against hybridmap's camera and poses, which share no formula with them."""
    rng = np.random.default_rng(1)
    points = AHEAD.back_project(rng.uniform(40, 200, (6, 2)), rng.uniform(2, 5, 6))
    pose = Pose2(0.4, -0.3, 0.2)
    landmarks = chart.drop(of_robot(points, AHEAD))
    assert np.allclose(in_robot(chart.lift(landmarks), AHEAD), points)
    seen = from_pose(chart.lift(landmarks), pose.vector, AHEAD.mount_forward)
    pixels = seen[:, :2] / seen[:, 2:3] * (AHEAD.fx, AHEAD.fy) + (AHEAD.cx, AHEAD.cy)
    assert np.allclose(pixels, AHEAD.project(pose.inverse().apply(points)))


@pytest.mark.parametrize("chart", CHARTS)
def test_complex_steps_are_derivatives(chart: Coordinates) -> None:
    """Against central differences."""
    landmarks = np.array([[0.2, -0.1, 1.4], [-0.3, 0.2, 0.6]])

    def moved(x: np.ndarray) -> np.ndarray:
        return chart.drop(from_pose(chart.lift(x), np.array([0.1, -0.05, 0.1]), 0.08))

    numeric = [(moved(landmarks + d) - moved(landmarks - d)) / 2e-6 for d in 1e-6 * np.eye(3)]
    assert np.abs(jacobian(moved, landmarks) - np.stack(numeric, axis=-1)).max() < 1e-8


def test_the_textbook_filter_agrees_with_ours_for_the_same_choices() -> None:
    run = short_run(2)
    ours = Ours(run, plain(run))
    for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
        ours.step(odometry, pixels)
    textbook = followed(run, Choice(Rays(), moving=True))
    x = np.concatenate([textbook.pose_vector, textbook.landmarks.ravel()])
    assert max(gap((x, textbook.covariance), ours.belief)) < 1e-7


def test_a_step_linearised_again_agrees_with_ours() -> None:
    """Ours skips a second linearisation that changes a step by less than 0.1 mm and 0.1 mrad."""
    run = short_run(3, steps=200)
    settings = FilterSettings(
        pixel_sigma=run.pixel_sigma, relinearisations=1, gate_probability=1 - 1e-15, slip_sigmas=np.inf
    )
    ours, once = Ours(run, settings), Ours(run, plain(run))
    for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
        ours.step(odometry, pixels)
        once.step(odometry, pixels)
    textbook = followed(run, Choice(Rays(), moving=True, relinearisations=1))
    pose_vector = ours.belief[0][:3]
    off = np.abs(textbook.pose_vector - pose_vector).max()
    assert off < 5e-5
    assert off < 0.2 * np.abs(once.belief[0][:3] - pose_vector).max()


def test_first_estimates_learn_nothing_of_where_the_world_is() -> None:
    """With derivatives at first estimates, moving robot and world together changes no measurement.

    The three directions (x, y, heading of everything) stay in the null space of the measurements for ever
    (Huang, Mourikis and Roumeliotis 2010); at the newest estimates the heading is lost from it.
    """
    run = short_run(4)
    left = {}
    for first in (True, False):
        filter_ = TextbookFilter(run, Choice(Points(), moving=False, first_estimates=first))
        together = np.zeros((27, 3))
        together[:3] = np.eye(3)
        right, _, ahead = filter_.landmarks.T
        together[5::3, 0], together[3::3, 1] = 1.0, -1.0
        together[5::3, 2], together[3::3, 2] = right, -(ahead + AHEAD.mount_forward)
        worst = []
        for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
            filter_.step(odometry, pixels)
            together = filter_.transition @ together
            worst.append(np.abs(filter_.measurement @ together).max(axis=0))
        left[first] = np.max(worst, axis=0)
    assert left[True].max() < 1e-12
    assert left[False][2] > 1e-4


def test_an_iterated_update_ends_where_the_posterior_does_not_slope() -> None:
    """One image from one prior: the gradient of the posterior, by differences, is zero at the mean."""
    run = short_run(5, steps=1)
    step = np.array([0.3, 0.1])
    prior, filter_ = (TextbookFilter(run, Choice(Rays(), moving=False, iterations=k)) for k in (1, 20))
    for each in (prior, filter_):
        each._move(step, step, each.pose_vector)
        # Two wheels leave a third direction certain; a cost needs a prior that has an inverse.
        each.covariance[[0, 1, 2], [0, 1, 2]] += 1e-4
    seen = np.isfinite(run.pixels[1][:, 0])
    filter_._update(seen, run.pixels[1])
    information = np.linalg.inv(prior.covariance)

    def cost(x: np.ndarray) -> float:
        probe = TextbookFilter(run, prior.choice)
        probe._vector = x
        off = x - prior._vector
        expected = probe._slopes(probe.pose_vector, probe.landmarks[seen]) * 277.0 + (160.0, 120.0)
        misfit = (run.pixels[1][seen] - expected) / run.pixel_sigma
        return float(0.5 * off @ information @ off + 0.5 * np.square(misfit).sum())

    at, sigmas = filter_._vector, np.sqrt(np.diag(prior.covariance))
    for ahead in 1e-3 * np.diag(sigmas):
        assert abs(cost(at + ahead) - cost(at - ahead)) / 2e-3 < 1e-3


def test_divergence_is_counted_and_gives_no_number() -> None:
    kept, off, lost = Outcome(1.0, 3.0, 4.0), Outcome(11.0, 99.0, 99.0), Outcome(math.inf, math.nan, math.nan)
    told = summary([kept, kept, off, lost])
    assert told["ratio_median"] == 6.0
    assert told["ratio_p90"] == math.inf
    assert told["diverged"] == 0.5
    assert (told["nees_pose"], told["nees_landmark"]) == (3.0, 4.0)
    assert math.isnan(summary([lost])["nees_pose"])


def test_a_filter_that_ends_without_a_number_has_diverged() -> None:
    run = short_run(6, steps=5)
    broken = Choice(Points(), moving=True, depth=math.nan)
    assert try_textbook(run, broken, 1.0).ratio == math.inf


def test_the_command_lists_all_filters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The whole command on one short run, which a process of its own makes."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "1")  # the command sets them, and would for all tests that follow
    monkeypatch.setattr(sys, "argv", ["ekf_variants", "--runs", "1", "--steps", "10", "--json"])
    main()
    told = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert set(told) == {
        "ratio_median",
        "ratio_p90",
        "nees_pose",
        "nees_landmark",
        "diverged",
        "nees_interval",
    }
    assert list(told["ratio_median"]) == [*TEXTBOOK, *OURS]


def test_zero_runs_are_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["ekf_variants", "--runs", "0"])
    with pytest.raises(SystemExit) as refused:
        main()
    assert refused.value.code == 2
    assert "--runs" in capsys.readouterr().err.splitlines()[-1]
