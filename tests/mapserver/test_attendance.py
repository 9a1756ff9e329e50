"""What robots do once no operator is there: pages, shells that wait, robots that were away, two servers."""

import json
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
from websockets.sync.client import connect

from mapweave.cli import main
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.attendance import Attendance, AttendanceSettings, Unattended
from mapweave.mapserver.http.live import EVERY
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.postgres_server import PostgresServer
from tests.mapserver.house import House
from tests.mapserver.stub_services import StubServices
from tests.mapserver.test_missions import THERE
from tests.waiting import eventually

GRACE = 30.0
DRIVES = Status("servoing", "", 7, 0, Pose2(0.0, 0.1, 0.0), False, "go", located=True)


class Watch:
    """Attendance on a clock of its own, at the server of a house; `after` looks at a time."""

    def __init__(self, house: House, unattended: Unattended = Unattended.STAND) -> None:
        self.now = 0.0
        server, settings = house.server, AttendanceSettings(unattended, GRACE)
        self.attendance = Attendance(
            settings, "s0", server._missions, server._store, server._roster.alive, lambda: self.now
        )

    def after(self, seconds: float) -> None:
        self.now += seconds
        self.attendance.check()


def test_a_robot_that_a_person_has_sent_stands_once_no_operator_is_there(house: House):
    watch, (_, control) = Watch(house), house.robot()
    watch.after(GRACE + 1.0)
    sent = house.person.go("r0", str(THERE), because="a parcel")
    watch.after(GRACE - 1.0)
    assert control.report == sent, "the grace begins with the mission"
    watch.attendance.attend()
    watch.after(GRACE - 1.0)
    assert control.report == sent, "an open page"
    watch.after(2.0)
    ended = control.report
    assert ended is not None and ended.order.kind is MissionKind.STOP
    assert (ended.order.by, ended.order.because) == ("s0", "no operator was there for 30 s")
    states = [report.state for report in house.person.missions()]
    assert states == [MissionState.REPLACED, MissionState.RUNNING]
    events = [event.words for event in house.server._commands.events]
    assert "no operator was there for 30 s" in events[-1]
    watch.after(100.0)
    assert control.report == ended, "once"
    assert house.person.go("r0", str(THERE)).state is MissionState.RUNNING, "it takes orders as before"


def test_it_goes_home_and_is_let_go_home(house: House):
    watch, (_, control) = Watch(house, Unattended.HOME), house.robot()
    house.person.go("r0", str(THERE))
    watch.after(GRACE + 1.0)
    home = control.report
    assert home is not None and home.order.node == min(house.mapped.truth) and home.order.goal == "home"
    watch.after(GRACE + 1.0)
    assert control.report == home


def test_a_robot_that_has_no_home_stands(house: House):
    watch, (_, control) = Watch(house, Unattended.HOME), house.robot("r5")
    house.person.explore("r5")
    watch.after(GRACE + 1.0)
    assert control.report is not None and control.report.order.kind is MissionKind.STOP


def test_robots_that_no_person_has_sent_go_on(house: House):
    watch, (link, control) = Watch(house), house.robot()
    control.begin(MissionKind.EXPLORE)
    link.report(DRIVES, 2)
    eventually(lambda: house.person.missions())
    watch.after(GRACE + 1.0)
    assert control.report is not None and control.report.order.by == "start"
    house.person.carried("r0")
    watch.after(GRACE + 1.0)
    assert control.report.order.kind is MissionKind.CARRIED, "a person is beside it"


def test_by_default_all_go_on(house: House):
    assert AttendanceSettings().words == ""
    watch, (_, control) = Watch(house, Unattended.GO_ON), house.robot()
    sent = house.person.go("r0", str(THERE))
    watch.after(1e6)
    assert control.report == sent


def test_a_robot_that_was_away_stands_when_it_is_back(house: House):
    watch, (link, control) = Watch(house), house.robot()
    house.person.go("r0", str(THERE))
    link.close()
    eventually(lambda: not house.server._roster.alive("r0"))
    watch.after(GRACE + 1.0)
    assert len(house.person.missions()) == 1, "nothing waits for it"
    house.robot()
    order = control.report
    assert order is not None
    eventually(lambda: house.server._roster.alive("r0"))
    watch.after(1.0)
    assert [report.order.kind for report in house.person.missions()] == [MissionKind.GO, MissionKind.STOP]


def test_who_waits_for_a_mission_is_there(house: House, monkeypatch):
    """As `mapweave go --wait` and `fleet.go(..., wait=60)` do."""
    monkeypatch.setattr("mapweave.fleet.SILENT", 0.05)
    watch, (link, control) = Watch(house), house.robot()
    report = house.person.go("r0", str(THERE), via=[str(min(house.mapped.truth))])
    waited: list[MissionReport] = []
    waiting = threading.Thread(target=lambda: waited.append(house.person.wait(report, 60.0)))
    waiting.start()
    for _ in range(5):
        watch.now += GRACE - 1.0
        eventually(lambda: watch.attendance._seen == watch.now)
        watch.attendance.check()
    assert control.report == report and len(house.person.missions()) == 1, "it is the same mission"
    control.take(MissionOrder.new("r0", MissionKind.STOP, "bert", after_ns=report.order.stamp_ns))
    link.report(DRIVES, 3)
    waiting.join(20)
    assert waited[0].state is MissionState.REPLACED


@pytest.mark.parametrize("wait", [False, True])
def test_a_shell_that_does_not_wait_says_what_follows(house: House, wait: bool, monkeypatch, capsys):
    house.robot()
    monkeypatch.setattr("mapweave.commands.missions.fleet_of", lambda _: nullcontext(house.person))
    give = ["go", "r0", str(THERE), *(["--wait", "--timeout", "0.2"] if wait else [])]
    assert main(give) == (4 if wait else 0)
    assert "operator" not in capsys.readouterr().err, "by default all go on"
    attendance = AttendanceSettings(Unattended.STAND)
    settings = replace(house.server._settings, attendance=attendance)
    monkeypatch.setattr(house.server, "_settings", settings)
    assert main(give) == (4 if wait else 0)
    said = (
        "Robots that were sent stand 30 s after the last operator's page was closed; --wait counts as a page"
    )
    assert (said in capsys.readouterr().err) is not wait


def test_a_page_that_may_only_look_is_no_operator(monkeypatch):
    """Without keys another machine, by way of a proxy, only reads."""
    services, seen = StubServices(), [0]
    monkeypatch.setattr(services, "attend", lambda: seen.__setitem__(0, seen[0] + 1))
    with Web(("127.0.0.1", 0), services) as web:
        where = f"ws://127.0.0.1:{web.port}/live"
        with connect(where, additional_headers={"X-Forwarded-For": "10.0.0.9"}) as viewer:
            # All that a page gets at its start: it is not asked whether it is there.
            kinds = {json.loads(viewer.recv(timeout=20))["kind"] for _ in range(3)}
            assert "state" in kinds and seen == [0]
        with connect(where):
            eventually(lambda: seen[0] > 2)
        # A look is taken twice a second: two in a row without one.
        eventually(lambda: _still(lambda: seen[0]), 20.0)


def test_of_servers_that_share_a_store_the_one_that_leads_gives_the_order(house: House, monkeypatch):
    """And also the others say that an operator was at their pages, once for as long as nothing is new."""
    watch, (_, control) = Watch(house), house.robot()
    written: list[tuple[str, bytes]] = []
    store = SimpleNamespace(shared=True, leads=False, put_result=lambda *row: written.append(row))
    monkeypatch.setattr(watch.attendance, "_store", store)
    sent = house.person.go("r0", str(THERE))
    watch.after(1.0)
    watch.after(GRACE)
    watch.after(GRACE)
    assert written == [("attended", b"s0")]
    assert control.report == sent
    store.leads = True
    watch.after(1.0)
    assert control.report is not None and control.report.order.kind is MissionKind.STOP


def test_a_store_that_takes_nothing_keeps_no_robot_from_standing(house: House, monkeypatch):
    def full(*_: object) -> None:
        raise InvalidFile("the database does not answer")

    watch, (_, control) = Watch(house), house.robot()
    monkeypatch.setattr(watch.attendance, "_store", SimpleNamespace(shared=True, leads=True, put_result=full))
    house.person.go("r0", str(THERE))
    watch.after(1.0)
    watch.after(GRACE)
    assert control.report is not None and control.report.order.kind is MissionKind.STOP


def _still(count: Callable[[], int]) -> bool:
    before = count()
    time.sleep(3.0 * EVERY)
    return count() == before


def test_servers_that_share_a_store_hear_of_each_others_operators(postgres: PostgresServer, tmp_path):
    hub = MemoryHub()
    address = postgres.database()
    with (
        MapServer(MemoryBus(hub), Keys("demo"), address, "s0", cache=tmp_path) as one,
        MapServer(MemoryBus(hub), Keys("demo"), address, "s1", cache=tmp_path) as other,
    ):
        before = other._attendance._seen
        one.attend()
        eventually(lambda: other._attendance._seen > before)
        assert other._attendance._here < before, "what is heard of others is not said again as the own"
