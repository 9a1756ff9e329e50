"""One drive of each driver of the benchmark, and what is said of it."""

import json
import math

import numpy as np
import pytest

from benchmarks.appearance import benchmark as appearance
from benchmarks.appearance.benchmark import Outcome, park
from benchmarks.appearance.drivers import DRIVERS, Eye
from benchmarks.servo.world import CAMERA, draw_task, in_view


def test_an_eye_sees_what_is_in_view_with_the_noise_that_it_says():
    task = draw_task(np.random.default_rng(0), 60)
    eye = Eye(task, 0.5, np.random.default_rng(1))
    looks = [eye.look(task.start) for _ in range(50)]
    ids = looks[0][0]
    assert (ids == np.flatnonzero(in_view(task.start.vector, task.points))).all()
    true = CAMERA.project(task.start.inverse().apply(task.points[ids]))
    assert np.std([pixels - true for _, pixels in looks]) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("name", ["appearance", "servo_with_depths"])
def test_a_drive_is_what_the_truth_says(name):
    """The same drive twice is the same, and it ends near the goal."""
    task = draw_task(np.random.default_rng(3), 60)
    first, second = (park(name, task, np.random.default_rng(5)) for _ in range(2))
    assert first.error_m == second.error_m
    assert first.arrived
    assert first.error_m < 0.02
    assert not first.violated
    assert first.length_m > math.hypot(task.start.x, task.start.y) - 0.02


def test_success_asks_for_all_of_it():
    good = Outcome(True, False, 0.004, 0.5, 1.0, 10.0, (1.0,))
    assert good.success(0.01)
    for spoilt in (
        Outcome(False, False, 0.004, 0.5, 1.0, 10.0, (1.0,)),
        Outcome(True, True, 0.004, 0.5, 1.0, 10.0, (1.0,)),
        Outcome(True, False, 0.02, 0.5, 1.0, 10.0, (1.0,)),
        Outcome(True, False, 0.004, 1.5, 1.0, 10.0, (1.0,)),
    ):
        assert not spoilt.success(0.01)


def test_the_command_prints_figures(monkeypatch, capsys):
    monkeypatch.setattr(appearance, "_TIME_LIMIT", 2.0)
    monkeypatch.setattr(
        "sys.argv", ["appearance", "--trials", "1", "--landmarks", "20", "--seed", "2", "--json"]
    )
    appearance.main()
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert figures["trials"] == {"20": 1}
    assert {"success", "error_m_median", "fov_violations", "tick_ms"} <= set(figures)
    assert set(figures["rivals"]) == set(DRIVERS) - {"appearance"}


def test_too_few_landmarks_are_refused_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["appearance", "--landmarks", "3"])
    with pytest.raises(SystemExit) as refused:
        appearance.main()
    assert refused.value.code == 2
    assert "at least 6 landmarks" in capsys.readouterr().err
