"""The loop of a real robot: it waits for neither disk nor network, and skips images rather than lag."""

import logging
import math
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapweave import Command, HybridMap, NodeId, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mapping_monitor import MappingMonitor
from mapweave.agent.mission import Idle, WhichWay
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.pipeline import TickResult
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.runner import Runner
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.wire.bus import Bus
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.zenoh_bus import ZenohBus
from tests.waiting import eventually

LONGEST_TICK = 1.0
"""s; far above what a tick takes on a busy machine, and far below what is waited for here."""


class Player:
    """The Robot protocol over a list of observations; notes when each was asked for."""

    def __init__(self, description: RobotDescription, observations: list[Observation]) -> None:
        self.description, self.left = description, list(observations)
        self.asked: list[float] = []

    def describe(self) -> RobotDescription:
        return self.description

    def sense(self) -> Observation | None:
        self.asked.append(time.monotonic())
        return self.left.pop(0) if self.left else None

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass


def forth_and_back(walls, description: RobotDescription) -> Player:
    """A drive before photographs that makes a node or two."""
    poses = [Pose2(0.025 * min(tick, 48 - tick)) for tick in range(48)]
    before = [poses[0], *poses]
    return Player(description, [walls.observe(before[k], poses[k], k + 1) for k in range(48)])


def run(robot: Player, bus: Bus, folder: Path) -> Agent:
    """Run an agent to the end of its observations; it stays open."""
    options = AgentOptions("r0", folder, epoch=1, mission=MissionKind.CARRIED, patience=0.0)
    agent = Agent(robot.describe, bus, Keys("fleet"), AgentSettings(), options)
    agent.run(robot, threading.Event())
    return agent


def test_a_disk_that_hangs_holds_up_no_tick(walls, description, tmp_path, monkeypatch):
    """Every commit hangs until all ticks are over: a loop that waited for one would never end."""
    ticks_over, waited = threading.Event(), []
    write = Journal.write

    def hanging(journal: Journal, *args: object) -> int:
        waited.append(ticks_over.wait(60.0))
        return write(journal, *args)

    monkeypatch.setattr(Journal, "write", hanging)
    robot, bus = forth_and_back(walls, description), MemoryBus(MemoryHub())
    agent = run(robot, bus, tmp_path)
    try:
        nodes = len(agent.pipeline.map.nodes)
        assert nodes and agent.replicator.status().waiting >= nodes
        ticks_over.set()
        assert agent.replicator.flush(60.0), "what waited in memory is written"
        assert waited and all(waited)
    finally:
        ticks_over.set()
        agent.close()
        bus.close()


def test_a_status_that_counts_a_node_counts_it_as_unsent_too(walls, description, tmp_path, monkeypatch):
    """Else the last node of a robot that is switched off then is taken for sent."""
    order: list[str] = []
    submit, report = Replicator.submit, FleetClient.report

    def submitted(replicator: Replicator, *args: Any) -> None:
        order.append("changes")
        submit(replicator, *args)

    def reported(fleet: FleetClient, *args: Any) -> None:
        order.append("status")
        report(fleet, *args)

    monkeypatch.setattr(Replicator, "submit", submitted)
    monkeypatch.setattr(FleetClient, "report", reported)
    run(forth_and_back(walls, description), MemoryBus(MemoryHub()), tmp_path).close()
    assert "changes" in order and order.count("status") == 48
    assert all(order[k + 1] == "status" for k, what in enumerate(order) if what == "changes")
    assert order[-1] == "status"
    ticks = "".join(what[0] for what in order)
    assert "sc" in ticks and "cc" not in ticks


def test_a_disk_that_hangs_holds_up_no_mission():
    """An order comes, and a mission ends, while the disk hangs: the loop goes on, the sender waits."""
    over, kept = threading.Event(), []

    def keep(reports: object) -> None:
        kept.append(over.wait(60.0))

    savers: list[threading.Thread] = []

    def defer(save: Callable[[], None]) -> None:
        savers.append(threading.Thread(target=save))
        savers[-1].start()

    control = MissionControl("r0", keep=keep, defer=defer)
    order = MissionOrder("m1", "r0", MissionKind.STOP, 1, "anna", None)
    sender = threading.Thread(target=control.take, args=(order,))
    sender.start()
    try:
        eventually(lambda: control.report is not None)
        assert control.next(True, 0.0, None) == Idle()
        assert control.follow(Status("idle", "", 0, 0, Pose2(), True)), "the stop is done"
        assert sender.is_alive() and not kept, "nothing is on the disk yet"
    finally:
        over.set()
        for thread in (sender, *savers):
            thread.join(60.0)
    assert kept == [True, True]


def test_a_dead_network_holds_up_no_tick(walls, description, tmp_path):
    """A machine that takes connections and never says a word."""
    deaf = socket.create_server(("127.0.0.1", 0))
    bus = ZenohBus(BusSettings(endpoints=(f"tcp/127.0.0.1:{deaf.getsockname()[1]}",)))
    try:
        robot = forth_and_back(walls, description)
        agent = run(robot, bus, tmp_path)
        took = [after - before for before, after in zip(robot.asked, robot.asked[1:], strict=False)]
        assert agent.pipeline.map.nodes
        assert max(took) < LONGEST_TICK
        agent.close()
    finally:
        deaf.close()  # else Zenoh waits ten seconds for its first word
        bus.close()


NODE = NodeId("r0", 1, 1)


class Slow:
    """A pipeline whose ticks take long, by a clock of its own."""

    lost = False
    map = HybridMap()

    def __init__(self, durations: list[float], asks_at: float = math.inf) -> None:
        self.durations, self.asks_at, self.now = durations, asks_at, 0.0

    def clock(self) -> float:
        return self.now

    def step(self, observation: Observation, answers: object, driven: object) -> TickResult:
        before, self.now = self.now, self.now + self.durations.pop(0)
        questions = (WhichWay(1, NODE, NODE),) if before <= self.asks_at < self.now else ()
        return TickResult(Command(), (), questions, Status("mapping", "", 0, 0, Pose2(), False))


class Fleet:
    """No fleet and no replicator; keeps what is reported."""

    def __init__(self, status_period: float = 0.0) -> None:
        self.status_period = status_period
        self.skipped: list[int] = []
        self.published: list[int] = []

    def server_in_reach(self) -> bool:
        return True

    def driven(self) -> None:
        pass

    def answers(self) -> tuple[object, ...]:
        return ()

    def report(
        self, status: Status, stamp_ns: int, battery: float | None, now: bool, skipped: int, silent: str
    ) -> None:
        self.skipped.append(skipped)
        self.silent = silent
        self.published += [round(stamp_ns * 1e-8)] * now


@pytest.mark.parametrize(
    ("period", "published"), [(0.0, [0, 5, 10, 15, 20, 23, 25]), (1.2, [0, 15, 23]), (4.0, [0, 23])]
)
def test_statuses_go_out_as_rarely_as_the_servers_want(
    description: RobotDescription, period: float, published: list[int]
):
    """Ticks of 0.1 s. With a question to the fleet one goes out at once."""
    slow, fleet = Slow([0.1] * 30, asks_at=2.35), Fleet(period)
    runner = Runner(slow, fleet, fleet, MissionControl("r0"), MappingMonitor(description), clock=slow.clock)
    for tick in range(30):
        runner.tick(Observation(tick * 100_000_000, Odometry(0.0, 0.0)))
    assert fleet.published == published


def test_a_base_that_does_not_answer_is_reported(description: RobotDescription):
    """`the wheels do not obey: check motor power` was all that a person heard of a port that was gone."""
    slow, fleet = Slow([0.02] * 2), Fleet()
    runner = Runner(slow, fleet, fleet, MissionControl("r0"), MappingMonitor(description), clock=slow.clock)
    for tick, words in enumerate(("/dev/ttyUSB0: the port is gone", "")):
        runner.tick(Observation(tick * 100_000_000, Odometry(0.0, 0.0), silent=words))
        assert fleet.silent == words


def test_images_that_come_during_a_long_tick_are_skipped_and_counted(description, caplog):
    """A gap of the camera's own, in a loop that had waited for it, is no image skipped."""
    stamps = [0.1, 0.2, 0.6, 0.7, 1.5, 1.6, 5.0]
    durations = [0.02, 0.35, 0.02, 0.02, 0.15, 0.15, 0.02]
    robot = Player(description, [Observation(round(s * 1e9), Odometry(0.0, 0.0)) for s in stamps])
    slow, fleet = Slow(durations), Fleet()
    runner = Runner(slow, fleet, fleet, MissionControl("r0"), MappingMonitor(description), clock=slow.clock)
    with caplog.at_level(logging.WARNING):
        assert runner.run(robot, threading.Event()) == 7
    # Of a gap of 3.4 s one image came during the tick of 0.15 s.
    assert fleet.skipped == [0, 0, 3, 3, 3, 3, 4] and runner.skipped == 4
    line, _ = caplog.messages
    assert line == "a tick took 350 ms instead of 100: 3 images skipped so far"


def test_a_recording_waits_for_the_loop(description, caplog):
    """Before, images that a recording lacks were reported as skipped, if the tick before took long."""
    robot = Player(description, [Observation(round(s * 1e9), Odometry(0.0, 0.0)) for s in (0.1, 0.6, 0.7)])
    slow, fleet = Slow([0.35, 0.35, 0.02]), Fleet()
    parts = slow, fleet, fleet, MissionControl("r0"), MappingMonitor(description)
    runner = Runner(*parts, clock=slow.clock, recorded=True)
    with caplog.at_level(logging.WARNING):
        assert runner.run(robot, threading.Event()) == 3
    assert runner.skipped == 0 and not caplog.messages


def test_a_driver_may_reuse_the_memory_of_its_image_and_count_stamps_with_numpy(description):
    """Else the last image becomes the next one: the camera is taken for frozen."""
    image = np.zeros((4, 4), np.uint8)

    class Reusing(Player):
        def sense(self) -> Observation | None:
            image[:] += 1
            return super().sense()

    class Keeping(Slow):
        def step(self, observation: Observation, answers: object, driven: object) -> TickResult:
            kept.append(observation)
            return super().step(observation, answers, driven)

    kept = list[Observation]()
    stamps = np.arange(1, 4) * 10**8
    robot = Reusing(description, [Observation(stamp, Odometry(0.0, 0.0), image) for stamp in stamps])
    slow, fleet = Keeping([0.02] * 3), Fleet()
    runner = Runner(slow, fleet, fleet, MissionControl("r0"), MappingMonitor(description), clock=slow.clock)
    assert runner.run(robot, threading.Event()) == 3
    assert [int(seen.image[0, 0]) for seen in kept if seen.image is not None] == [1, 2, 3]
    assert all(type(seen.stamp_ns) is int for seen in kept)
