"""Missions by way of the map server: goals in words, robots that are away, a server that is started again."""

import threading
import time
from dataclasses import replace

import pytest

from mapweave import fleet
from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_STAMP_NS
from mapweave.hybridmap.mission_order import (
    MAX_KEPT,
    MissionKind,
    MissionOrder,
    MissionReport,
    MissionRequest,
    MissionState,
    new_id,
)
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver import mission_relay
from mapweave.mapserver.http.web import Web
from mapweave.wire.messages import encode
from tests.mapserver.house import KEYS, ROBOT, House, ask
from tests.waiting import eventually

THERE = NodeId("r0", 1, 3)


def standing(robot: str) -> AgentStatus:
    return AgentStatus(Status("standing", "", 0, 0, Pose2(), False), 1, robot, 1)


def test_a_robot_is_sent_and_reports_and_all_can_see_it(house: House):
    link, control = house.robot()
    entry = house.entry("r0")
    assert entry.alive and entry.component == 0
    begin = min(house.mapped.truth)
    assert entry.merged_from_robot is not None
    assert entry.merged_from_robot.distance(Pose2(0.0, 0.1)) < 0.1, "the room lies in r0's own frame"
    report = house.person.go("r0", str(THERE))
    assert report == control.report and report.state is MissionState.RUNNING
    assert (report.order.node, report.order.by) == (THERE, "anna")
    assert house.person.go("r0", "home").order.node == begin
    (first, second) = house.person.missions()
    assert (first.state, second.state) == (MissionState.REPLACED, MissionState.RUNNING)
    control.next(True, 0.0, None)
    control.follow(Status("gave up", "a wall", 7, 0, Pose2(), False, given_up=True))
    waited = house.person.wait(second, 0.0)
    assert waited.open, "nothing has been heard yet"
    link.report(Status("gave up", "a wall", 7, 0, Pose2(), False), 2)
    eventually(lambda: house.person.missions()[-1].state is MissionState.FAILED)
    assert house.person.missions("r0")[-1].reason == "a wall"
    with pytest.raises(InvalidValue, match="there is no robot r9; there are: r0"):
        house.person.missions("r9")
    assert house.entry("r0").status.mission.reason == "a wall"


def test_no_mission_is_older_than_what_waiting_for_it_has_returned(house: House, monkeypatch):
    link, control = house.robot()
    report = house.person.go("r0", str(THERE))
    # A server that is slow: the person hears the robot's last status first.
    monkeypatch.setattr(house.server._missions, "hear", lambda status: None)
    control.next(True, 0.0, None)
    control.follow(Status("gave up", "a wall", 7, 0, Pose2(), False, given_up=True))
    done = threading.Event()

    def go_on_reporting() -> None:
        while not done.wait(0.02):
            link.report(Status("gave up", "a wall", 7, 0, Pose2(), False), 2)

    reporting = threading.Thread(target=go_on_reporting)
    reporting.start()
    waited = house.person.wait(report, 20.0)
    done.set()
    reporting.join()
    assert waited.state is MissionState.FAILED
    assert house.person.missions() == (waited,)


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        ("r9.1.1", "goal r9.1.1 is not in the merged map: there is no map r9.1; known are: "),
        ("kitchen", "goal 'kitchen' is no place of this map: give a node"),
        ("1,2,3", "give a node"),
        ("1e400,0", "give a node"),
        ("50,50", "nothing is mapped within 2 m of 50,50: the nearest node is r0.1"),
    ],
)
def test_a_goal_that_does_not_exist_is_refused_at_once(house: House, goal: str, reason: str):
    _, control = house.robot()
    with pytest.raises(InvalidValue, match=reason):
        house.person.go("r0", goal)
    assert control.report is None and house.person.missions() == ()


def test_what_a_robot_without_nodes_is_sent_to_is_not_called_its_start(house: House):
    house.robot("r7")
    with pytest.raises(InvalidValue, match=r"^goal r9\.1\.1 is not in the merged map"):
        house.person.go("r7", "r9.1.1")


@pytest.mark.parametrize(
    ("via", "reason"),
    [
        ("r9.1.1", "^via point r9.1.1 is not in the merged map: there is no map r9.1; known are: "),
        ("kitchen", "^via point 'kitchen' is no place of this map: give a node"),
        ("50,50", "^nothing is mapped within 2 m of 50,50"),
    ],
)
def test_a_place_on_the_way_that_does_not_exist_is_not_called_the_goal(house: House, via: str, reason: str):
    link, control = house.robot()
    with pytest.raises(InvalidValue, match=reason):
        house.person.go("r0", str(THERE), via=[str(THERE), via])
    assert control.report is None and house.person.missions() == ()
    link.close()
    house.stop_server()
    with pytest.raises(InvalidValue, match=r"^via point 'kitchen': without a map server give a node"):
        house.person.go("r0", str(THERE), via=["kitchen"])


def test_a_position_leads_to_the_nearest_node(house: House):
    house.robot()
    merged = house.server._worker.current().merged
    place = merged.pose(THERE)
    report = house.person.go("r0", f"{place.x + 0.01:.3f}, {place.y - 0.01:.3f}")
    assert report.order.node is not None
    assert merged.pose(report.order.node).distance(place) < 0.05


def test_a_robot_that_is_away_gets_its_newest_mission_when_it_is_back(house: House):
    house.robot_that_left()
    first = house.person.go("r0", str(THERE))
    assert first.state is MissionState.SENT and "when it is back" in first.reason
    second = house.person.explore("r0")
    house.restart_server()
    states = [report.state for report in house.person.missions()]
    assert states == [MissionState.REPLACED, MissionState.SENT], "the record outlasts the server"
    _, control = house.robot()
    eventually(lambda: control.report is not None)
    assert control.report == MissionReport(second.order, MissionState.RUNNING)
    eventually(lambda: house.person.missions()[-1].state is MissionState.RUNNING)


@pytest.mark.parametrize("by", ["name", "all", "http"])
def test_a_robot_that_is_away_gets_no_mission_from_before_it_was_stopped(house: House, by: str):
    """The stop failed, and the robot drove off once it was back."""
    house.robot_that_left()
    assert house.person.go("r0", str(THERE)).state is MissionState.SENT
    if by == "http":
        with Web(("127.0.0.1", 0), house.server) as web:
            states = [report["state"] for report in ask(web, "POST", "/stop")[1]["reports"]]
    else:
        states = [report.state for report in house.person.stop("r0" if by == "name" else "")]
    assert states == ["sent"], "who stops it must hear that it does not answer"
    assert [one.state for one in house.person.missions()] == [MissionState.REPLACED, MissionState.SENT]
    _, control = house.robot()
    eventually(lambda: control.report is not None)
    assert control.report is not None and control.report.order.kind is MissionKind.STOP


def test_a_robot_that_drives_is_stopped_before_a_server_says_who_is_away(house: House, monkeypatch):
    _, control = house.robot()
    asked: list[bool] = []

    def slow(person: fleet.Fleet) -> set[str]:
        asked.append(control.report is not None and control.report.order.kind is MissionKind.STOP)
        return set()

    monkeypatch.setattr(fleet.Fleet, "_awaited", slow)
    house.person.explore("r0")
    assert [report.order.robot for report in house.person.stop()] == ["r0"]
    assert asked == [True]


def test_a_goal_is_of_the_map_that_a_robot_makes_now(house: House):
    """Right after a start of the server its status has not come, and after its own its last one is older."""
    bus, first = house.bus(), min(house.mapped.truth)
    alive = bus.announce(KEYS.agent_alive(ROBOT))
    eventually(lambda: house.entry("r0").alive)
    assert house.entry("r0").status is None
    assert house.person.go("r0", "home").order.node == first
    alive.close()
    house.robot_that_left()
    assert house.person.go("r0", "home").order.node == first
    bus.announce(KEYS.agent_alive(ROBOT._replace(epoch=2)))
    eventually(lambda: house.entry("r0").alive)
    with pytest.raises(InvalidValue, match=r"^the map r0\.2 of r0 has no node yet: it has no home$"):
        house.person.go("r0", "home")


def test_a_robot_whose_map_is_retired_hears_why_it_has_no_home(house: House):
    house.robot()
    eventually(lambda: house.entry("r0").alive)
    house.person.retire(str(ROBOT), because="before the move")
    assert house.server.settle(30.0)
    with pytest.raises(
        InvalidValue, match=r'^r0 has no home: map r0\.1 is retired by .*: "before the move"$'
    ):
        house.person.go("r0", "home")


def test_a_mission_for_a_robot_that_stays_away_expires(house: House, monkeypatch):
    house.robot_that_left()
    monkeypatch.setattr(mission_relay, "EXPIRY", 0.0)
    house.person.explore("r0")
    eventually(lambda: house.person.missions()[-1].state is MissionState.FAILED)
    assert "did not answer within 0 s" in house.person.missions()[-1].reason


def test_a_robot_that_was_never_heard_of_gets_no_mission(house: House):
    with pytest.raises(InvalidValue, match="no robot r7 has been heard of"):
        house.person.explore("r7")


def test_the_refusal_names_the_robots_that_there_are(house: House):
    with pytest.raises(InvalidValue, match=r"no robot r7 has been heard of$"):
        house.person.explore("r7")
    house.robot()
    eventually(lambda: house.entry("r0").alive)
    for name, rest in (("r00", r" \(is it r0\?\)$"), ("gustav", "; there are: r0$")):
        with pytest.raises(InvalidValue, match=f"no robot {name} has been heard of{rest}"):
            house.person.explore(name)


def test_a_robot_says_nothing_of_the_missions_of_others(house: House):
    """Neither in its status, nor as the answer to an order of its own."""
    link, control = house.robot()
    report = house.person.explore("r0")
    lie = MissionReport(replace(report.order, stamp_ns=report.order.stamp_ns + 1), MissionState.DONE, 1.0)
    newer = replace(lie, order=replace(lie.order, id="newer"))
    liar, gives = house.bus(), [lie]
    liar.announce(KEYS.agent_alive(MapId("r1", 1)))
    liar.serve(KEYS.mission("r1"), lambda request: request.reply(encode(gives[0])))
    status = standing("r1")
    liar.publish(KEYS.agent_status("r1"), encode(status))
    eventually(lambda: house.entry("r1").status == status)
    for gives[0] in (lie, newer):
        for one in (replace(status, mission=gives[0]), replace(status, robot="r0")):
            liar.publish(KEYS.agent_status("r1"), encode(one))
        answer = house.person.explore("r1")
        assert answer.state is MissionState.REFUSED and "report of another mission" in answer.reason
    link.report(Status("standing", "", 7, 0, Pose2(), False), 2)
    held = [one for one in house.person.missions("r0") if one.order.id == report.order.id]
    assert held == [control.report] == [report]
    assert house.entry("r1").status == status


@pytest.mark.slow
def test_one_robot_displaces_no_missions_of_others(house: House):
    """By very many missions with stamps of the far future, which it says that it has, or is to get."""
    house.robot()
    report = house.person.explore("r0")
    liar = house.bus()
    liar.announce(KEYS.agent_alive(MapId("r1", 1)))
    status = standing("r1")

    def say(mission_id: str, state: MissionState) -> None:
        order = MissionOrder(mission_id, "r1", MissionKind.EXPLORE, MAX_STAMP_NS, "anna")
        new = replace(status, mission=MissionReport(order, state))
        liar.publish(KEYS.agent_status("r1"), encode(new))
        eventually(lambda: house.entry("r1").status == new)

    for k in range(MAX_KEPT + 5):
        say(f"m{k}", MissionState.RUNNING)
    say(report.order.id, MissionState.DONE)
    say("never", MissionState.SENT)
    missions = house.person.missions()
    assert [one for one in missions if one.order.robot == "r0"] == [report] and len(missions) == MAX_KEPT
    assert all(one.state is not MissionState.SENT for one in missions), "only the server sends missions"
    house.restart_server()
    assert report in house.person.missions()
    assert house.person.go("r0", str(THERE)) in house.person.missions()


def test_a_robot_that_says_it_is_very_far_away_hides_no_other(house: House):
    """Where it is by its own words lies beyond the range of messages."""
    house.robot()
    liar, there = house.bus(), Pose2(1e6, 1e6, 0.0)
    liar.announce(KEYS.agent_alive(MapId("r1", 1)))
    for number, fix in enumerate(sorted(house.mapped.truth)):
        lie = Status("x", "", 0, 0, Pose2(), False, "goto", fix_node=fix, node_from_robot=there)
        liar.publish(KEYS.agent_status("r1"), encode(AgentStatus(lie, number, "r1", 1)))
        eventually(
            lambda lie=lie: (
                [one.status.status for one in house.server.robots().robots if one.status][1:] == [lie]
            )
        )
        entry = house.entry("r0")
        assert entry.merged_from_robot is not None and entry.component == 0


def test_a_robot_that_was_stopped_on_its_way_is_shown_where_it_stands(house: House):
    house.robot()
    bus, aside = house.bus(), Pose2(0.1, 0.0, 0.2)
    node = min(house.mapped.truth)  # the merged frame is that of the smallest node
    bus.announce(KEYS.agent_alive(MapId("r1", 1)))
    stands = Status("idle", "no mission", 0, 0, Pose2(), False, "idle", fix_node=node, node_from_robot=aside)
    bus.publish(KEYS.agent_status("r1"), encode(AgentStatus(stands, 1, "r1", 1)))
    eventually(lambda: house.entry("r1").merged_from_robot is not None)
    known = house.entry("r1").merged_from_robot
    assert known is not None and known.vector == pytest.approx(aside.vector)


def test_a_robot_does_not_say_what_was_ordered(house: House):
    house.robot()
    report = house.person.explore("r0")
    other = replace(report.order, kind=MissionKind.STOP, by="bert", stamp_ns=1)
    status = replace(house.entry("r0").status, mission=MissionReport(other, MissionState.DONE, 1.0))
    house.bus().publish(KEYS.agent_status("r0"), encode(status))
    eventually(lambda: house.person.missions()[0].state is MissionState.DONE)
    assert house.person.missions()[0].order == report.order


@pytest.mark.parametrize("by_http", [False, True])
def test_no_robot_keeps_others_from_being_stopped(house: House, monkeypatch, by_http: bool):
    """Robots that hang, that answer nonsense, and after whose mission none can come."""
    _, control = house.robot()
    monkeypatch.setattr(mission_relay, "ANSWER", 20.0)
    monkeypatch.setattr(fleet, "ANSWERED", 20.0)
    over, bus = threading.Event(), house.bus()
    last = MissionOrder("last", "a1", MissionKind.EXPLORE, MAX_STAMP_NS, "anna")
    answers = {
        "a0": lambda request: request.reply(b"?"),
        "a1": lambda request: request.reply(encode(MissionReport(last, MissionState.REPLACED))),
        "a2": lambda request: (over.wait(20.0), request.reply(b"?")),
    }
    for name, answer in answers.items():
        bus.announce(KEYS.agent_alive(MapId(name, 1)))
        (house.bus() if name == "a2" else bus).serve(KEYS.mission(name), answer)
        new = standing(name)
        if name == "a1":
            new = replace(new, mission=MissionReport(last, MissionState.RUNNING))
        bus.publish(KEYS.agent_status(name), encode(new))
        eventually(lambda new=new, name=name: house.entry(name).status == new)
    errors = []

    def stop() -> None:
        if by_http:
            with Web(("127.0.0.1", 0), house.server) as web:
                reports = ask(web, "POST", "/stop")[1]["reports"]
            errors.extend(f"{r['order']['robot']} {r['state']}: {r['reason']}" for r in reports)
            return
        with pytest.raises(NotConnected) as error:
            house.person.stop()
        errors.append(str(error.value))

    stopping = threading.Thread(target=stop)
    stopping.start()
    eventually(lambda: control.report is not None and control.report.order.kind is MissionKind.STOP)
    over.set()
    stopping.join()
    if by_http:
        assert [words.split(":")[0] for words in sorted(errors)] == [
            "a0 refused", "a1 refused", "a2 refused", "r0 running"
        ]  # fmt: skip
    else:
        assert "a0" in errors[0]


def test_robots_that_hang_keep_no_other_from_a_mission_that_waits(house: House, monkeypatch):
    """Their own time to answer is waited for once, and not once for each of them."""
    monkeypatch.setattr(mission_relay, "ANSWER", 0.2)
    over, bus = threading.Event(), house.bus()
    names = [f"a{number}" for number in range(5)]
    for name in names:
        bus.publish(KEYS.agent_status(name), encode(standing(name)))
        eventually(lambda name=name: house.entry(name).status is not None)
        assert house.person.explore(name).state is MissionState.SENT
    house.robot_that_left()
    house.person.explore("r0")
    monkeypatch.setattr(mission_relay, "ANSWER", 5.0)
    for name in names:
        other = house.bus()
        other.serve(KEYS.mission(name), lambda request: (over.wait(60.0), request.reply(b"?")))
        other.announce(KEYS.agent_alive(MapId(name, 1)))
    eventually(lambda: all(house.entry(name).alive for name in names))
    _, control = house.robot()
    eventually(lambda: control.report is not None, 20.0)
    over.set()


def test_a_mission_of_far_ahead_is_refused(house: House):
    """Behind the greatest stamp no order could come, not even to stop."""
    _, control = house.robot()
    for stamp_ns in (MAX_STAMP_NS, time.time_ns() + 2 * 86_400 * 10**9):
        request = MissionRequest(new_id(), "r0", MissionKind.EXPLORE, stamp_ns, "eve")
        with pytest.raises(InvalidValue, match=r"days ahead of the server's clock"):
            house.server.command(request)
    assert control.report is None and house.person.missions() == ()
    assert house.person.explore("r0").state is MissionState.RUNNING


def test_without_a_server_orders_go_to_the_robot_directly(house: House):
    link, control = house.robot()
    other, _ = house.robot("r1")
    house.stop_server()
    assert house.person.go("r0", "r1.1.5").state is MissionState.RUNNING
    with pytest.raises(InvalidValue, match="without a map server give a node"):
        house.person.go("r0", "1,2")
    assert {report.order.robot for report in house.person.stop()} == {"r0", "r1"}
    assert control.report is not None and control.report.order.kind is MissionKind.STOP
    assert [entry.robot for entry in house.person.status().robots] == ["r0", "r1"]
    for call in (house.person.missions, house.person.map_bytes):
        with pytest.raises(NotConnected, match="no map server of fleet fleet answers"):
            call()
    link.close()
    other.close()
    with pytest.raises(NotConnected, match="robot r0 does not answer: is its agent running"):
        house.person.stop("r0")


@pytest.mark.parametrize("with_server", [True, False])
def test_a_person_whose_clock_is_behind_can_still_stop_a_robot(house: House, with_server: bool):
    _, control = house.robot()
    # By an hour: what is a day ahead no server hands on.
    ahead = MissionOrder("late", "r0", MissionKind.EXPLORE, time.time_ns() + 3_600_000_000_000, "bob")
    control.take(ahead)
    if not with_server:
        house.stop_server()
    (report,) = house.person.stop("r0")
    assert report.state is MissionState.RUNNING and report.order.rank > ahead.rank
    again = house.person.go("r0", "r1.1.1" if not with_server else str(THERE))
    assert again.state is MissionState.RUNNING and control.report == replace(again, reason="")


@pytest.mark.parametrize("with_server", [True, False])
def test_a_direct_order_of_far_ahead_leaves_later_orders(house: House, with_server: bool):
    """The robot takes it, as its own clock may be wrong; what is ordered later holds all the same."""
    _, control = house.robot()
    control.take(MissionOrder("absurd", "r0", MissionKind.EXPLORE, MAX_STAMP_NS, "eve"))
    if not with_server:
        house.stop_server()
    (report,) = house.person.stop("r0")
    assert report.state is MissionState.RUNNING and report.order.kind is MissionKind.STOP
    assert control.report is not None and control.report.order.id == report.order.id
    control.take(MissionOrder("again", "r0", MissionKind.EXPLORE, MAX_STAMP_NS, "eve"))
    go = house.person.go("r0", "r1.1.1" if not with_server else str(THERE))
    assert go.state is MissionState.RUNNING and control.report.order.id == go.order.id
    if with_server:
        known = {report.order.id: report.state for report in house.person.missions()}
        assert [known.get(which) for which in ("absurd", "again")].count(MissionState.RUNNING) == 0


def test_the_map_comes_as_a_map_file(house: House):
    assert len(house.person.content.poses) == 7
