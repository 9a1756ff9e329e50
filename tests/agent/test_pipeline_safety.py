"""The whole pipeline never drives into what it sees, nor on and on against what it does not see."""

import math

import numpy as np
import pytest

from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.mission import Explore
from mapweave.agent.observation import Command
from mapweave.agent.pipeline import Pipeline
from tests.agent.ranged_body import BEARINGS, BODY, ROOM, live, on, still
from tests.quick import first_quick


@pytest.fixture
def reckless(monkeypatch):
    """An explorer that drives against any obstacle."""

    def want(command: Command) -> Pipeline:
        monkeypatch.setattr(Explorer, "next_move", lambda self: command)
        return on(Explore())

    return want


def near(bearing: float, distance: float) -> np.ndarray:
    """Readings of the rangers with one thing in the way."""
    readings = np.full(len(BEARINGS), BODY.ranger_reach)
    off = np.abs(np.angle(np.exp(1j * (np.array(BEARINGS) - bearing))))
    readings[off < 0.3] = distance
    return readings


def test_no_command_drives_into_a_seen_obstacle(walls, reckless):
    pipeline = reckless(Command(0.3, 0.2))
    step = pipeline.step(still(walls, proximity=near(0.0, 0.02)))
    assert step.command == Command(0.0, 0.2), "it may still turn"
    assert "stopped: an obstacle is ahead" in step.status.detail
    assert "no nodes yet" in step.status.detail
    step = pipeline.step(still(walls, tick=1, proximity=near(0.0, 0.12)))
    assert 0 <= step.command.forward < 0.3
    for free in (near(math.pi, 0.02), near(0.0, 2.0)):
        step = pipeline.step(still(walls, tick=2, proximity=free))
        assert step.command == Command(0.3, 0.2)
        assert "obstacle" not in step.status.detail


def test_no_drive_backward_into_an_obstacle(walls, reckless):
    pipeline = reckless(Command(-0.3, 0.0))
    assert pipeline.step(still(walls, proximity=near(math.pi, 0.02))).command == Command()
    assert pipeline.step(still(walls, tick=1, proximity=near(0.0, 0.02))).command == Command(-0.3, 0.0)


@pytest.mark.parametrize("speed", first_quick([0.3, -0.3], 1))
def test_a_reckless_drive_ends_before_the_wall(walls, reckless, speed):
    _, _, poses = live(walls, reckless(Command(speed, 0.05)), 150)
    x, y = np.array([[p.x, p.y] for p in poses]).T
    gap = np.min([x - ROOM[0], ROOM[1] - x, y - ROOM[2], ROOM[3] - y])
    assert gap > BODY.radius
    assert math.hypot(x[-1], y[-1]) > 0.5


def test_a_robot_that_is_stuck_at_something_its_rangers_miss_stops(walls, reckless):
    pipeline = reckless(Command(0.3, 0.0))
    for tick in range(3):
        step = pipeline.step(still(walls, tick=tick, proximity=near(0.0, 3.0), bumped=True))
    assert step.command.forward <= 0.0
    assert "bump" in step.status.detail
