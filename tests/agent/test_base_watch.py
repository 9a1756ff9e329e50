"""A base that reports nothing while the loop waits for it: the fleet hears of it, with since when."""

import threading
import time
from contextlib import closing

import pytest

from mapweave import Command, Observation, Odometry, RobotDescription
from mapweave.agent import base_watch
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.wire.bus import Sample
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode
from tests.waiting import eventually

KEYS = Keys("fleet")
BEFORE, AFTER = 6, 12
"""Observations before the base falls silent, and in all."""


class Quiet:
    """The Robot protocol of a base that reports nothing for a while."""

    def __init__(self, description: RobotDescription) -> None:
        self.description, self.again = description, threading.Event()
        self.sensed, self.last_at = 0, 0.0

    def describe(self) -> RobotDescription:
        return self.description

    def sense(self) -> Observation | None:
        if self.sensed == BEFORE:
            self.last_at = time.monotonic()
            assert self.again.wait(60.0)
        self.sensed += 1
        return None if self.sensed > AFTER else Observation(self.sensed * 10**8, Odometry(0.0, 0.0))

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass


@pytest.mark.parametrize("recorded", [False, True])
def test_that_a_base_reports_nothing_is_in_the_status_with_since_when(
    recorded: bool, description: RobotDescription, tmp_path, monkeypatch
):
    """Of a body behind the bus only the agent's log said so; the status was an old one, without a trouble."""
    monkeypatch.setattr(base_watch, "SILENT", 0.2)
    monkeypatch.setattr(base_watch, "EVERY", 0.05)
    hub, robot, seen = MemoryHub(), Quiet(description), list[AgentStatus]()

    def hear(sample: Sample) -> None:
        seen.append(decode(sample.payload, AgentStatus))

    def asked() -> AgentStatus:
        (reply,) = people.ask(KEYS.agent_status("r0"), b"", 10.0)
        return decode(reply.payload, AgentStatus)

    options = AgentOptions(
        "r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=0.0, recorded=recorded
    )
    with closing(MemoryBus(hub)) as people, closing(MemoryBus(hub)) as bus:
        people.subscribe(KEYS.agent_status("r0"), hear)
        with closing(Agent(robot.describe, bus, KEYS, AgentSettings(), options)) as agent:
            loop = threading.Thread(target=agent.run, args=(robot, threading.Event()))
            loop.start()
            try:
                eventually(lambda: robot.last_at > 0.0)
                if recorded:
                    watches = [one for one in threading.enumerate() if one.name == "base watch"]
                    assert not watches, "a recording is no base"
                else:
                    eventually(lambda: sum(bool(one.last_error) for one in seen) >= 3)
                    now = asked()
                    assert now.last_error == "the robot's base reports nothing"
                    assert 0.2 <= now.error_age <= time.monotonic() - robot.last_at + 1.0
                    assert seen[-1].error_age > seen[-3].error_age
                    # It is the status of its last report otherwise.
                    assert now.status == seen[-1].status and now.stamp_ns == BEFORE * 10**8
            finally:
                robot.again.set()
                loop.join(60.0)
            assert asked().last_error == "" and asked().stamp_ns == AFTER * 10**8
