"""A robot whose map server is killed, in the simulator: it goes home, stands or goes on, as it is set."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mapweave import AgentStatus, Pose2
from mapweave.agent.mission_control import GONE
from mapweave.agent.settings import AgentSettings, WithoutServer
from mapweave.scenarios.fleet import TrialStage
from mapweave.scenarios.scenario import load_scenario, scenario_path
from mapweave.wire.messages import decode
from tests.simulator import needs_simulator

TICKS = 10
"""In a second."""


class Robot:
    """One robot that explores an office, and its server."""

    def __init__(self, folder: Path, without_server: WithoutServer) -> None:
        from mapweave.scenarios.local_fleet import LocalFleet

        scenario = load_scenario(scenario_path("office"), ["robots=1", "world.rooms=3"])
        settings = AgentSettings(without_server=without_server)
        self.fleet, self.tick = LocalFleet(TrialStage(scenario, 5, folder, settings)), 0
        self._heard: list[AgentStatus] = []
        key = self.fleet.keys.agent_status("r0")
        self._listening = self.fleet.bus.subscribe(
            key, lambda sample: self._heard.append(decode(sample.payload, AgentStatus))
        )
        self.fleet.start()
        self.run(1)
        self.start = self.truth

    def run(self, ticks: int) -> None:
        self.tick += ticks
        self.fleet.advance(self.tick)

    def run_until(self, condition: Callable[[], bool], seconds: int) -> None:
        """Go on until something holds, at most for so long: the caller asserts it."""
        for _ in range(seconds):
            if condition():
                return
            self.run(TICKS)

    @property
    def truth(self) -> Pose2:
        assert self.fleet._simulation is not None
        return self.fleet._simulation.truth("r0")

    @property
    def doing(self) -> str:
        """What others hear of it."""
        status = self._heard[-1].status
        return f"{status.doing}: {status.detail}"

    @property
    def home(self) -> Pose2:
        """In the world, where its first node was made; its map begins where it was put down."""
        nodes = self.fleet._agents["r0"].pipeline.map.nodes
        return self.start @ nodes[min(nodes)].map_from_robot.mean


@contextmanager
def exploring(folder: Path, without_server: WithoutServer, seconds: int = 60) -> Iterator[Robot]:
    robot = Robot(folder, without_server)
    try:
        robot.run(seconds * TICKS)
        yield robot
    finally:
        robot.fleet.end()


@needs_simulator
@pytest.mark.slow
@pytest.mark.timeout(400)
def test_it_goes_home_and_goes_on_when_the_server_is_back(tmp_path):
    with exploring(tmp_path, WithoutServer.HOME) as robot:
        assert robot.truth.distance(robot.home) > 0.5, "it has to drive"
        robot.fleet.kill_server()
        robot.run(int(GONE - 1.0) * TICKS)
        assert "no map server" not in robot.doing, "one that is started again is back by then"
        parked = "parked at the goal: goes home: no map server for 10 s; at the goal"
        robot.run_until(lambda: robot.doing.startswith(parked), 60)
        assert robot.doing.startswith(parked)
        assert robot.truth.distance(robot.home) < 0.05
        robot.run(20 * TICKS)
        assert robot.truth.distance(robot.home) < 0.05, "it stays there"
        robot.fleet.start_server()
        robot.run_until(lambda: robot.truth.distance(robot.home) > 0.5, 30)
        assert "goes home" not in robot.doing and robot.truth.distance(robot.home) > 0.5, robot.doing


@needs_simulator
@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize("setting", [WithoutServer.STAND, WithoutServer.GO_ON])
def test_it_stands_or_goes_on(tmp_path, setting: WithoutServer):
    with exploring(tmp_path, setting, seconds=30) as robot:
        robot.fleet.kill_server()
        robot.run(int(GONE + 2.0) * TICKS)
        before, way, turned = robot.truth, 0.0, 0.0
        for _ in range(20):
            last = robot.truth
            robot.run(TICKS)
            way += robot.truth.distance(last)
            turned += abs((last.inverse() @ robot.truth).heading)
        stands = setting is WithoutServer.STAND
        assert (robot.truth.distance(before) + turned < 0.05) is stands, (way, turned)
        assert (way + turned > 1.0) is not stands
        assert robot.doing.startswith("standing: no map server for 10 s") is stands, robot.doing
