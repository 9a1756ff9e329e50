"""One parking of the benchmark, and what is said of it."""

import json
import math

import numpy as np
import pytest

from benchmarks.parking import benchmark as parking
from benchmarks.parking.run import LEAST_VISIBLE, park
from benchmarks.parking.scene import AHEAD, FARTHEST, LEAST_SEEN, MOST_TURNED, NEAREST, ParkingScene
from mapweave.hybridmap.pose import Pose2


@pytest.fixture(scope="module")
def scene() -> ParkingScene:
    """One view, mapped by the robot."""
    return ParkingScene((4, 0), one_view=True)


@pytest.mark.slow
def test_starts_are_drawn_by_the_rule(scene):
    rng = np.random.default_rng(3)
    for _ in range(20):
        start = scene.draw_start(rng)
        assert NEAREST <= math.hypot(start.x, start.y) <= FARTHEST
        assert start.x <= AHEAD
        assert abs(start.heading) <= MOST_TURNED
        camera, points = scene.goal.camera, start.inverse().apply(scene.goal.points_in_robot)
        bearings = np.arctan2(points[:, 1], points[:, 0])
        assert (np.abs(bearings) < camera.semi_aperture + 0.01).sum() >= LEAST_SEEN
        there = scene.world_from_goal @ start
        assert scene.plan.is_free(there.x, there.y, 0.2)


@pytest.mark.slow
def test_parking_is_judged_by_the_truth(scene):
    """The same start twice gives the same to the last bit, and success is what its record shows."""
    start = Pose2(-0.7, 0.2, 0.1)
    first, second = (park(scene, start, 0.7, seed=5) for _ in range(2))
    assert first.arrived
    assert np.array_equal(first.record.true, second.record.true)
    assert np.array_equal(first.record.believed, second.record.believed, equal_nan=True)
    assert np.allclose(first.record.true[0], start.vector, atol=2e-3), "it was put down where it should"
    x, y, heading = first.record.true[-1]
    assert first.error_m == pytest.approx(math.hypot(x, y), abs=1e-3)
    assert first.error_deg == pytest.approx(abs(math.degrees(heading)), abs=0.1)
    assert math.hypot(x, y) < 0.02
    exact = first.error_m <= 0.01 and first.error_deg <= 1.0
    assert first.success == (exact and min(first.record.seen) >= LEAST_VISIBLE and not first.collisions)
    # The servo gets the truth: better than a robot that only counts the turns of its wheels.
    assert first.believed_m == pytest.approx(first.error_m, abs=0.02)
    assert 1e-4 < first.sigma_m < 0.01
    off = first.record.believed[-1] - first.record.true[-1]
    assert math.hypot(off[0], off[1]) < 4.0 * first.sigma_m
    assert first.nees < 16.3, "99.9 % of right covariances"


@pytest.mark.slow
def test_the_command_prints_figures_and_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("benchmarks.parking.run.TIME_LIMIT", 6.0)
    out = tmp_path / "deep" / "out"
    arguments = ["parking", "--starts", "1", "--goals", "3", "--one-view", "--seed", "4", "--json", "--out"]
    monkeypatch.setattr("sys.argv", [*arguments, str(out)])
    parking.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"success", "error_m_median", "error_deg_median", "nees_mean", "fov_violations"} <= set(figures)
    assert figures["starts"] == 1
    assert sorted(path.name for path in out.iterdir()) == ["fig12.png", "fig13.png", "fig14.png"]
