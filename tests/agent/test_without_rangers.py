"""A robot without proximity sensors: it stands and says why, is driven, or explores by its camera."""

from dataclasses import replace

import pytest

from mapweave import Command, Observation, Odometry, Pose2
from mapweave.agent.cautious_driving import CREEP, SLOW
from mapweave.agent.mission import Carried, Driven, Explore, Mission
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.ranger_monitor import announcement
from mapweave.agent.settings import AgentSettings, ExplorerSettings
from tests.agent.ranged_body import BODY, on, rangers

BARE = replace(BODY, ranger_bearings=(), ranger_reach=0.0)
ALLOWED = AgentSettings(exploration=ExplorerSettings(without_rangers=True))


class Life:
    """A robot before the pictures, whose base executes commands exactly until it meets something."""

    def __init__(self, walls, pipeline: Pipeline, body=BARE, end: float = 9.0) -> None:
        self.pose, self.steps, self.poses = Pose2(), list[TickResult](), list[Pose2]()
        self._walls, self._pipeline, self._body, self._end = walls, pipeline, body, end
        self._moved, self._tick, self._bumped = Odometry(0.0, 0.0), 0, False

    def go(self, ticks: int, driven: Driven | None = None) -> TickResult:
        for _ in range(ticks):
            proximity = rangers(self.pose) if self._body.ranger_bearings else rangers(self.pose)[:0]
            image = self._walls.render(self.pose)
            seen = Observation(self._tick * 100_000_000, self._moved, image, proximity, self._bumped)
            step = self._pipeline.step(seen, driven=driven)
            self._moved = Odometry(step.command.forward * 0.1, step.command.turn * 0.1)
            there = self.pose @ self._moved.motion()
            self._bumped = there.x > self._end
            if self._bumped:
                self._moved, there = Odometry(0.0, 0.0), self.pose
            self.pose, self._tick = there, self._tick + 1
            self.steps.append(step)
            self.poses.append(there)
        return self.steps[-1]


def test_it_stands_and_says_why(walls):
    life = Life(walls, on(Explore(), body=BARE))
    step = life.go(30)
    assert {step.command for step in life.steps} == {Command()}
    assert step.status.doing == "standing still"
    assert "no nodes yet: without proximity sensors it does not explore by itself" in step.status.detail
    assert "`mapweave drive r0`" in step.status.detail
    assert "--without-rangers" in step.status.detail
    assert not step.status.finished


def test_it_announces_what_it_will_not_do():
    refused, allowed = (announcement(BARE, "r5", explores) for explores in (False, True))
    assert [len(refused), len(allowed)] == [3, 3]
    assert "does not stop before obstacles" in refused[0]
    assert "`mapweave drive r5`" in refused[1]
    assert f"{CREEP:g} to {SLOW:g} m/s" in allowed[1]
    assert "only along edges" in refused[2]
    assert announcement(BODY, "r5", False) == []
    assert announcement(replace(BARE, max_forward=0.0), "r5", False) == [], "a robot that is carried"


@pytest.mark.parametrize("mission", [Explore(), Carried()])
def test_a_person_drives_it_and_it_maps(walls, mission: Mission):
    life = Life(walls, on(mission, body=BARE))
    life.go(3)
    step = life.go(30, Driven(Command(0.2, 0.0)))
    assert step.command == Command(0.2, 0.0)
    assert step.status.doing == "driven by a person"
    life.go(40, Driven(Command(-0.1, 0.2)))
    step = life.go(3, Driven(Command(), 2.0))
    assert step.command == Command()
    assert step.status.doing == "standing: nothing is heard of who drives it"
    assert step.status.nodes >= 1
    life.go(5)
    assert {step.command for step in life.steps[-5:]} == {Command()}, "its mission drives nothing"


@pytest.mark.slow
def test_a_persons_command_comes_before_the_mission_and_behind_the_guard(walls):
    life = Life(walls, on(Explore(), body=BODY), BODY)
    life.go(5)
    step = life.go(1, Driven(Command(0.0, 0.3)))
    assert step.command == Command(0.0, 0.3)
    life.go(12, Driven(Command(0.0, 0.0)))
    assert life.poses[-1] == life.poses[-11], "the mission waits"
    step = life.go(120, Driven(Command(0.3, 0.0)))
    assert "obstacle" in step.status.detail
    assert rangers(life.pose).min() > 0.0, "it has touched nothing that its rangers see"
    life.go(60)
    assert any(step.command != Command() for step in life.steps[-60:]), "then the mission goes on"


@pytest.mark.slow
def test_where_it_may_explore_it_creeps_backs_off_from_a_touch_and_maps(walls):
    pipeline = on(Explore(), ALLOWED, BARE)
    life = Life(walls, pipeline, end=0.1)
    step = life.go(60)
    speeds = [step.command.forward for step in life.steps]
    assert max(speeds) == pytest.approx(CREEP), "nothing is known ahead"
    touched = [step for step in life.steps if "backing off" in step.status.detail]
    assert touched
    assert min(step.command.forward for step in touched) == -CREEP
    step = life.go(300)
    assert step.status.nodes >= 1
    assert max(step.command.forward for step in life.steps) <= SLOW
    assert not step.status.finished
