"""Who has sent, stopped or driven which robot, when and why, is in the history."""

import logging
import re
import time
from dataclasses import replace

import pytest

from mapweave.cli import main
from mapweave.hybridmap.agent_status import AgentStatus, HandDrive, Status
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.mission_order import AT_START, MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver import command_history
from mapweave.mapserver.command_history import CommandHistory
from mapweave.mapserver.http.web import Web
from tests.mapserver.house import House, ask
from tests.waiting import eventually

THERE = NodeId("r0", 1, 3)
MOST = 40
"""Events that are kept here: with as many as a server keeps each further one takes milliseconds."""


def commands(house: House) -> list[str]:
    """Their words, without the ids of missions."""
    events = [event for event in house.person.history() if event.kind is MapEventKind.COMMANDED]
    assert all(abs(event.stamp_ns - time.time_ns()) < 60e9 for event in events)
    return [re.sub(r"mission [0-9a-f]{12}", "mission ID", event.words) for event in events]


def test_missions_and_stops_are_in_the_history_with_who_and_why(house: House):
    link, _ = house.robot()
    house.person.go("r0", str(THERE), because="a guest waits")
    house.person.explore("r0")
    with Web(("127.0.0.1", 0), house.server) as web:
        assert ask(web, "POST", f"/robots/r0/go?goal={THERE}&by=bob&because=tea&id=first")[0] == 200
        assert ask(web, "POST", f"/robots/r0/go?goal={THERE}&by=bob&because=tea&id=first")[0] == 200
        assert ask(web, "POST", f"/robots/r0/stop?by=bob&because={'a' * 400}")[0] == 200, "a stop stops"
        assert ask(web, "POST", "/stop?by=bob&because=a%20child")[0] == 200
        status, refused = ask(web, "POST", f"/robots/r0/go?goal={THERE}&because={'a' * 400}")
        assert status == 400 and "a reason has at most 300 characters" in refused["error"]
        expected = [
            f'r0: go to {THERE}, by anna: "a guest waits" (mission ID)',
            "r0: explore, by anna (mission ID)",
            f'r0: go to {THERE}, by bob: "tea" (mission first)',
            f'r0: stop, by bob: "{"a" * 300}" (mission ID)',
            'r0: stop, by bob: "a child" (mission ID)',
        ]
        assert commands(house) == expected
        events = ask(web, "GET", "/history")[1]["history"]
        assert [one["kind"] for one in events].count("commanded") == 5
    # To the robot directly: the server hears of it by the robot's status.
    house.person.stop("r0", because="a wet floor")
    link.report(Status("stopped", "", 7, 0, Pose2(), False), 2)
    eventually(lambda: len(commands(house)) == 6)
    assert commands(house)[-1] == 'r0: stop, by anna: "a wet floor" (mission ID, as r0 says)'
    # It outlasts the server, and is no part of the map.
    before = commands(house)
    house.restart_server()
    assert commands(house) == before
    assert not any(event.kind is MapEventKind.COMMANDED for event in house.person.map().history)


def test_a_command_is_an_event_at_once(house: House):
    house.robot()
    events = house.person.events(30.0)
    house.person.explore("r0")
    event = next(one for one in events if isinstance(one, MapEvent) and one.kind is MapEventKind.COMMANDED)
    assert event.words.startswith("r0: explore, by anna (mission ")
    events.close()  # type: ignore[attr-defined]


def test_a_drive_by_hand_is_in_the_history(house: House):
    house.robot()
    begin = 1_772_366_400_250_000_000
    for over in (False, False, True, True):
        drive = HandDrive("anna", begin, over)
        status = AgentStatus(Status("driven", "", 7, 0, Pose2(), False), 1, "r0", 1, drive=drive)
        house.server._hear(status)
    by = "by anna since 2026-03-01 12:00:00.250 UTC (as r0 says)"
    assert commands(house) == [f"r0: driven by hand, {by}", f"r0: the drive by hand is over, {by}"]


def test_the_reason_of_the_shell_goes_with_the_mission(monkeypatch, house: House):
    _, control = house.robot()
    monkeypatch.setattr("mapweave.commands.missions.fleet_of", lambda arguments: house.person)
    monkeypatch.setattr(type(house.person), "close", lambda self: None)
    for command in (["go", "r0", str(THERE)], ["explore", "r0"], ["stop", "r0"], ["stop", "--all"]):
        assert main([*command, "--because", "a guest waits"]) == 0
        assert control.report is not None and control.report.order.because == "a guest waits"


class Record:
    """The results of a store."""

    def __init__(self) -> None:
        self.values: dict[str, bytes] = {}
        self.full = False

    def result(self, name: str) -> bytes | None:
        return self.values.get(name)

    def put_result(self, name: str, value: bytes) -> None:
        if self.full:
            raise InvalidFile("the disk is full")
        self.values[name] = value


@pytest.fixture
def kept_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command_history, "MOST", MOST)


@pytest.mark.usefixtures("kept_few")
def test_a_robot_that_reports_mission_after_mission_displaces_no_other():
    record, clock = Record(), iter(range(1, 10**9))
    history = CommandHistory(record, lambda: next(clock), lambda job: None)
    history.order(MissionOrder.new("r1", MissionKind.STOP, "anna"), False)
    for _ in range(2 * MOST):
        history.order(MissionOrder.new("r0", MissionKind.EXPLORE, "anna"), True)
    assert len(history.events) == MOST and history.events[0].words.startswith("r1: stop, by anna")


def test_what_two_servers_note_at_once_and_a_full_disk_does_not_take_is_not_lost(caplog):
    record = Record()
    first, second = (CommandHistory(record, time.time_ns, lambda job: None) for _ in range(2))
    order = MissionOrder.new("r0", MissionKind.STOP, "anna")
    first.order(order, False)
    second.order(order, True)
    second.order(MissionOrder.new("r1", MissionKind.STOP, "bob"), False)
    record.full = True
    for _ in range(3):
        first.write()
    assert not record.values and [one.levelno for one in caplog.records] == [logging.WARNING]
    record.full = False
    for one in (first, second, first, second):
        one.write()
        one.reload()
    for one in (first, second, CommandHistory(record, time.time_ns, lambda job: None)):
        words = [event.words for event in one.events]
        assert len(words) == 2 and sum("mission " + order.id in one for one in words) == 1


def test_a_robots_first_report_of_an_order_that_a_person_gave_it_names_the_robot(house: House):
    order = MissionOrder.new("r0", MissionKind.EXPLORE, "eve")
    report = MissionReport(order, MissionState.RUNNING)
    status = AgentStatus(Status("standing", "", 7, 0, Pose2(), False), 1, "r0", 1, mission=report)
    first = MissionReport(MissionOrder.new("r0", MissionKind.EXPLORE, AT_START), MissionState.RUNNING)
    for one in (replace(status, mission=first), status, status):
        house.server._hear(one)
    assert commands(house) == ["r0: explore, by eve (mission ID, as r0 says)"], "no person has said the first"


@pytest.mark.usefixtures("kept_few")
def test_a_clock_that_was_put_back_loses_no_command():
    """A machine without a clock of its own begins in another year: what is noted then is the newest all the
    same.
    """
    record, now = Record(), [10**18]
    history = CommandHistory(record, lambda: now[0], lambda job: job())  # type: ignore[arg-type]

    def note(count: int, by: str) -> list[str]:
        before = len(history.events)
        for _ in range(count):
            now[0] += 1
            history.order(MissionOrder.new("r1", MissionKind.STOP, by), heard=False)
        assert len(history.events) >= min(before, MOST)
        return [event.words.split(", by ")[1].split(" ")[0] for event in history.events]

    note(MOST, "anna")
    now[0] = 0
    assert note(3, "bob")[-3:] == ["bob"] * 3
    # Another server on the store, or this one when it starts again.
    again = CommandHistory(record, lambda: now[0], lambda job: job())  # type: ignore[arg-type]
    assert again.events == history.events
    again.reload()
    assert again.events == history.events
    now[0] = 2 * 10**18
    assert note(2, "carl")[-6:] == ["anna", *["bob"] * 3, *["carl"] * 2]
