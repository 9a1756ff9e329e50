"""The record of missions on the disk: several servers write it, and a write may wait or fail."""

import logging
import threading
import time
from dataclasses import replace
from typing import Any

import pytest

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver import mission_relay
from mapweave.mapserver.mission_relay import MissionRelay
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapserver.house import KEYS, House
from tests.waiting import eventually


class SharedRecord:
    """The results of a store of two servers, one of which writes before it has heard of the other's."""

    def __init__(self) -> None:
        self.value: bytes | None = None
        self.writes = 0

    def result(self, _: str) -> bytes | None:
        return self.value

    def put_result(self, _: str, value: bytes) -> None:
        self.value, self.writes = value, self.writes + 1


def test_two_servers_that_write_at_once_lose_no_mission_of_each_other():
    record: Any = SharedRecord()

    def relay() -> MissionRelay:
        return MissionRelay(
            MemoryBus(MemoryHub()), KEYS, record, pytest.fail, time.time_ns, lambda job: job()
        )

    first, second = relay(), relay()
    for one, robot in ((first, "r1"), (second, "r2")):
        report = MissionReport(MissionOrder.new(robot, MissionKind.EXPLORE, "anna"), MissionState.RUNNING)
        status = Status("standing", "", 0, 0, Pose2(), False)
        one.hear(AgentStatus(status, 1, robot, 1, mission=report))
    for one in (first, second) * 2:
        one.reload()
        one.retry()
    assert record.writes == 3, "once each, and again what the second wrote over"
    assert [report.order.robot for report in relay().missions().reports] == ["r1", "r2"]


@pytest.mark.parametrize("off", [-3600.0, 0.0, 3600.0], ids=["put back", "as it was", "put forward"])
def test_a_mission_for_a_robot_that_is_away_expires_whatever_the_clock_does(off: float):
    record: Any = SharedRecord()
    hours, seconds = [0.0], [0.0]

    def time_ns() -> int:
        return 10**18 + round((hours[0] + seconds[0]) * 1e9)

    relay = MissionRelay(
        MemoryBus(MemoryHub()), KEYS, record, pytest.fail, time_ns, lambda job: job(),
        monotonic=lambda: seconds[0],
    )  # fmt: skip
    order = replace(MissionOrder.new("r1", MissionKind.EXPLORE, "anna"), stamp_ns=time_ns())
    relay._note(MissionReport(order, MissionState.SENT))
    relay.retry()
    hours[0] = off
    last = 0.0
    while relay.missions().reports[0].state is MissionState.SENT and seconds[0] < 7200.0:
        last = seconds[0]
        seconds[0] += 10.0
        relay.retry()
    assert relay.missions().reports[0].state is MissionState.FAILED
    assert last <= mission_relay.EXPIRY and (off > 0.0 or last == mission_relay.EXPIRY)


def test_a_record_that_cannot_be_written_now_holds_up_no_robot_and_no_reader(house: House):
    """As with a PostgreSQL whose standby is away: the commit waits until there is one."""
    house.robot()
    eventually(lambda: house.entry("r0").alive)
    store, writes = house.server._store, threading.Event()
    write = store.put_result
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "put_result", lambda name, value: writes.wait(20.0) and write(name, value))
        order = MissionOrder.new("r0", MissionKind.EXPLORE, "anna")
        status = Status("standing", "", 0, 0, Pose2(), False)
        began = time.monotonic()
        house.server._missions.hear(
            AgentStatus(status, 1, "r0", 1, mission=MissionReport(order, MissionState.RUNNING))
        )
        assert [one.order for one in house.server.missions().reports] == [order]
        assert time.monotonic() < began + 5.0
        assert store.result(mission_relay.KEPT) is None
        writes.set()
        eventually(lambda: store.result(mission_relay.KEPT) is not None)


def test_a_record_that_could_not_be_written_is_written_later(caplog):
    class FullDisk(SharedRecord):
        full = True

        def put_result(self, name: str, value: bytes) -> None:
            if self.full:
                raise InvalidFile("the disk is full")
            super().put_result(name, value)

    record: Any = FullDisk()
    relay = MissionRelay(MemoryBus(MemoryHub()), KEYS, record, pytest.fail, time.time_ns, lambda job: job())
    order = MissionOrder.new("r1", MissionKind.EXPLORE, "anna")
    status = Status("standing", "", 0, 0, Pose2(), False)
    with caplog.at_level(logging.INFO):
        relay.hear(AgentStatus(status, 1, "r1", 1, mission=MissionReport(order, MissionState.RUNNING)))
        for _ in range(3):
            relay.retry()
        assert record.result(mission_relay.KEPT) is None
        record.full = False
        for _ in range(3):
            relay.retry()
    assert record.writes == 1 and record.result(mission_relay.KEPT) is not None
    said = [line.getMessage() for line in caplog.records]
    assert [("is full" in line, "again" in line) for line in said] == [(True, True), (False, True)], said
