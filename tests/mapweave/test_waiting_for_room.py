"""A robot that needs a new map on a full disk stands, and says why, until there is room."""

import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mapweave import AgentStatus, Command, MapId, MissionKind, Observation, Pose2, Robot, RobotDescription
from mapweave.agent.replication.journal import Journal
from mapweave.agent.settings import AgentSettings
from mapweave.processes import agent as agent_module
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.storage.full_disks import FullDisk
from mapweave.storage.os_errors import DISK_FULL
from mapweave.wire.bus import Sample
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.waiting import eventually

KEYS = Keys("fleet")
TIMES = 5
"""The disk does not take the map so many times."""


class Lifted(Robot):
    """A robot that a person carries off once."""

    def __init__(self) -> None:
        walls, way = PhotoWalls(), [Pose2(float(x)) for x in np.arange(-1.0, -0.3, 0.025)]
        mapped = [
            walls.observe(before, now, tick) for tick, (before, now) in enumerate(pairwise([way[0], *way]))
        ]
        away = walls.observe(Pose2(2.0), Pose2(2.0), len(way))
        self._views = [*mapped, replace(away, kidnapped=True), replace(away, stamp_ns=away.stamp_ns + 10**8)]
        self._tick = 0
        self.commands: list[Command] = []

    def describe(self) -> RobotDescription:
        return DESCRIPTION

    def sense(self) -> Observation | None:
        self._tick += 1
        return self._views[self._tick - 1] if self._tick <= len(self._views) else None

    def act(self, command: Command) -> Command:
        self.commands.append(command)
        return command

    def close(self) -> None:
        """Nothing is held."""


@pytest.fixture(autouse=True)
def full(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """The disk takes no second map at first."""
    monkeypatch.setattr(agent_module, "DISK_PAUSE", 0.01)
    takes, left = Journal.open_map, [TIMES]

    def open_map(journal: Journal, epoch: int | None) -> MapId:
        if epoch == 2 and left[0]:
            left[0] -= 1
            raise FullDisk.of_file(f"r0.sqlite: agent journal: {DISK_FULL}", tmp_path / "r0.sqlite")
        return takes(journal, epoch)

    monkeypatch.setattr(Journal, "open_map", open_map)
    yield
    assert left == [0]


def test_it_stands_and_systemd_and_its_fleet_hear_why(tmp_path):
    hub, robot = MemoryHub(), Lifted()
    said, alive, seen = list[str](), list[int](), list[AgentStatus]()
    there: set[str] = set()

    def hear(sample: Sample) -> None:
        seen.append(decode(sample.payload, AgentStatus))

    def watch(key: str, is_there: bool) -> None:
        (there.add if is_there else there.discard)(key)

    def wait() -> None:
        # What is published arrives meanwhile, and the robot is in its fleet.
        eventually(lambda: sum(one.status.doing == "standing" for one in seen) > len(alive))
        assert there
        alive.append(len(robot.commands))

    options = AgentOptions("r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=0.0)
    with closing(MemoryBus(hub)) as people, closing(MemoryBus(hub)) as bus:
        people.subscribe(KEYS.agent_status("r0"), hear)
        people.watch(KEYS.agents_alive(), watch)
        agent = Agent(
            robot.describe, bus, KEYS, AgentSettings(), options, print_line=said.append, on_wait=wait
        )
        try:
            agent.run(robot, threading.Event())
        finally:
            agent.close()
    assert len(alive) == TIMES, "about every second, since the watchdog of systemd waits 30 s"
    # The wheels are held before each of them.
    assert alive == [*range(alive[0], alive[0] + TIMES)]
    assert robot.commands[alive[0] - 1 : alive[-1]] == [Command(0.0, 0.0)] * TIMES
    standing = [one for one in seen if one.status.doing == "standing" and DISK_FULL in one.status.detail]
    assert len(standing) == TIMES and not any(one.status.located for one in standing)
    assert sum("cannot begin a map before there is room" in line for line in said) == 1
    assert said[-1].endswith("it begins map r0.2, and the old one stays")
