"""A robot whose proximity sensors are not read stands, says so, and goes on when they are."""

from collections.abc import Callable

import numpy as np
import pytest

from mapweave import Camera, Command, NodeId, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.drivers.messages import decode_observation, encode_observation
from mapweave.agent.mission import Carried, Explore, GoTo, Idle
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.ranger_monitor import RangerMonitor
from mapweave.agent.settings import AgentSettings, ExplorerSettings
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from tests.agent.ranged_body import BODY, MAP, on, rangers
from tests.quick import first_quick

Broken = Callable[[np.ndarray], np.ndarray]
ALLOWED = AgentSettings(exploration=ExplorerSettings(without_rangers=True))
NONE: Broken = lambda readings: readings[:0]  # noqa: E731
FEWER: Broken = lambda readings: readings[:5]  # noqa: E731
MORE: Broken = lambda readings: np.append(readings, readings)  # noqa: E731
NAN: Broken = lambda readings: np.where(np.arange(len(readings)) == 3, np.nan, readings)  # noqa: E731


class Drive:
    """A base that executes its commands, among the photographs, with rangers that may fail."""

    def __init__(self, walls, pipeline: Pipeline) -> None:
        self.walls, self.pipeline = walls, pipeline
        self.pose, self.tick, self._moved = Pose2(), 0, Odometry(0.0, 0.0)

    def run(self, ticks: int, broken: Broken = lambda readings: readings) -> list[TickResult]:
        steps = []
        for _ in range(ticks):
            observation = Observation(
                self.tick * 100_000_000, self._moved, self.walls.render(self.pose), broken(rangers(self.pose))
            )
            step = self.pipeline.step(observation)
            self._moved = Odometry(step.command.forward * BODY.tick, step.command.turn * BODY.tick)
            self.pose = self.pose @ self._moved.motion()
            self.tick += 1
            steps.append(step)
        return steps


@pytest.mark.parametrize(("broken", "read"), first_quick([
    (NONE, "none"), (NAN, "23"), (FEWER, "5"), (MORE, "48"),
], 2), ids=["none", "nan", "fewer", "more"])  # fmt: skip
@pytest.mark.parametrize(
    ("mission", "ticks"), [(Explore(), 20), (GoTo(NodeId("r0", 1, 1)), 130)], ids=["explore", "goto"]
)
def test_it_stops_and_reports_while_they_are_silent_and_then_goes_on(walls, mission, ticks, broken, read):
    drive = Drive(walls, on(mission))
    moving = drive.run(ticks)
    assert any(step.command != Command() for step in moving)
    silent = drive.run(12, broken)
    assert {step.command for step in silent} == {Command()}
    status = silent[-1].status
    assert status.doing == "standing still"
    assert f"24 proximity sensors promised, {read} read for 1.2 s: standing" in status.detail
    after = drive.run(ticks)
    assert any(step.command != Command() for step in after)
    assert "promised" not in after[0].status.detail


@pytest.mark.slow
def test_a_long_silence_does_not_count_against_what_the_robot_was_doing(walls):
    """The same commands as without the silence: behaviours have waited, not given up.

    40 s are longer than the patience of each of them.
    """
    pipelines = [Drive(walls, on(Explore())) for _ in range(2)]
    commands = []
    for drive, silence in zip(pipelines, (0, 400), strict=True):
        first = drive.run(40)
        drive.run(silence, NONE)
        commands.append([step.command for step in first + drive.run(60)])
    steady, interrupted = commands
    assert any(command.forward for command in steady[40:])
    # The images of the pause are the same image: the filter has learnt from it a little more.
    for a, b in zip(steady, interrupted, strict=True):
        assert a.forward == pytest.approx(b.forward, abs=0.05)
        assert a.turn == pytest.approx(b.turn, abs=0.05)


@pytest.mark.parametrize("mission", [Idle(), Carried()])
def test_an_agent_without_wheels_needs_no_rangers(walls, mission):
    steps = Drive(walls, on(mission)).run(5, NONE)
    assert all("promised" not in step.status.detail for step in steps)


def test_a_robot_that_promises_none_is_not_held_back_by_their_silence(walls):
    description = RobotDescription(Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3))
    drive = Drive(walls, on(Explore(), body=description, settings=ALLOWED))
    assert any(step.command != Command() for step in drive.run(20, NONE))


def test_a_single_sensor_is_named():
    monitor = RangerMonitor(RobotDescription(BODY.camera, ranger_bearings=(0.0,), ranger_reach=1.0))
    assert monitor.fault == ""
    monitor.see(np.zeros(0), Odometry(0.0, 0.0))
    assert monitor.fault == "1 proximity sensor promised, none read for 0.1 s: standing"
    monitor.see(np.array([0.4]), Odometry(0.0, 0.0))
    assert monitor.fault == ""


@pytest.mark.slow
@pytest.mark.parametrize("broken", first_quick([NONE, FEWER], 1))
def test_a_simulated_robot_touches_nothing(broken):
    """24 s in an office: with free room assumed it touched a wall several times."""
    world = make_world("office", 3)
    with Simulation(world, ["r0"], 3) as simulation:
        pipeline = Pipeline(MAP, simulation.describe("r0"))
        pipeline.set_mission(Explore())
        command = Command()
        for _ in range(240):
            seen = simulation.step({"r0": command})["r0"]
            through = Observation(
                seen.stamp_ns, seen.odometry, seen.image, broken(seen.proximity), seen.bumped
            )
            step = pipeline.step(decode_observation(encode_observation(through)))
            command = step.command
        assert simulation.collisions("r0") == 0
    assert "16 proximity sensors promised" in step.status.detail
