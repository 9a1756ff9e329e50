"""Which mission holds: orders that come twice, late or never, robots switched off, servers that go."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import NodeId, Pose2
from mapweave.agent.mission import Carried, Explore, GoTo, Idle
from mapweave.agent.mission_control import GONE, MissionControl, as_mission
from mapweave.agent.replication.journal import Journal
from mapweave.agent.settings import WithoutServer
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.limits import MAX_STAMP_NS
from mapweave.hybridmap.mission_order import (
    MAX_KEPT,
    MOST_APART_NS,
    MissionKind,
    MissionOrder,
    MissionReport,
    MissionState,
    later_stamp,
)
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait

GOAL, HOME, NOWHERE = NodeId("r1", 1, 5), NodeId("r0", 1, 1), NodeId("r0", 1, 999)


def order(
    stamp_ns: int, kind: MissionKind = MissionKind.GO, name: str = "", node: NodeId = GOAL
) -> MissionOrder:
    return MissionOrder(
        name or f"m{stamp_ns}", "r0", kind, stamp_ns, "anna", node if kind is MissionKind.GO else None
    )


def status(*, finished: bool = False, given_up: bool = False, progress: float = 0.0, why: str = "") -> Status:
    return Status("x", why, 0, 0, Pose2(), finished, given_up=given_up, progress=progress)


class Disk:
    """Keeps reports as the journal does."""

    def __init__(self) -> None:
        self.rows: dict[str, MissionReport] = {}

    def keep(self, reports) -> None:
        self.rows.update({report.order.id: report for report in reports})

    def robot(self, without_server: WithoutServer = WithoutServer.GO_ON) -> MissionControl:
        control = MissionControl("r0", self.rows.values(), self.keep, without_server)
        control.unknown_goal = lambda node: "no such node" if node == NOWHERE else ""
        return control


kinds = st.sampled_from([MissionKind.GO, MissionKind.STOP, MissionKind.EXPLORE])
given_orders = st.lists(
    st.builds(order, st.integers(0, 6), kinds, st.sampled_from("abcdefgh"), st.sampled_from([GOAL, NOWHERE])),
    min_size=1, max_size=12, unique_by=lambda one: one.id,
)  # fmt: skip


@given(given_orders, st.data())
def test_the_newest_order_holds_however_they_come(orders: list[MissionOrder], data: st.DataObject):
    """Lost, doubled, out of order, with steps of the robot and power failures in between."""
    disk = Disk()
    control, over, arrived = disk.robot(), {}, set()
    comings = data.draw(st.lists(st.sampled_from(orders), max_size=24))
    for coming in comings:
        report = control.take(coming)
        arrived.add(coming)
        assert report.order == coming
        assert control.take(coming) == report, "twice is once"
        applied = control.next(True, 0.0, HOME)
        holds = max((o for o in arrived if o.node != NOWHERE), key=lambda o: o.rank, default=None)
        held = control.report
        assert (held.order if held else None) == holds
        if applied is not None:
            assert holds is not None and held is not None
            assert applied == as_mission(holds) if held.open else applied in (as_mission(holds), Idle())
        if data.draw(st.booleans()):
            control.follow(status(finished=data.draw(st.booleans()), given_up=data.draw(st.booleans())))
        for one in arrived:
            known = control.take(one)
            if one.id in over and one.kind is not MissionKind.EXPLORE:
                assert known == over[one.id], "what is over stays over"
            if not known.open:
                over[one.id] = known
        if data.draw(st.booleans()):
            before = {one.id: control.take(one) for one in arrived}
            control = disk.robot()
            assert (control.report.order if control.report else None) == holds
            for one in arrived:
                if one.kind is not MissionKind.EXPLORE and before[one.id].state is not MissionState.RUNNING:
                    assert control.take(one) == before[one.id]


FAR_AHEAD = (2 * MOST_APART_NS, MAX_STAMP_NS - 1, MAX_STAMP_NS)


@pytest.mark.parametrize("kind", [MissionKind.GO, MissionKind.EXPLORE, MissionKind.STOP])
@pytest.mark.parametrize("over", [False, True])
def test_no_stamp_keeps_a_robot_from_later_orders(kind: MissionKind, over: bool):
    """One clock is wrong then, and the order that comes later holds, also after a restart."""
    disk = Disk()
    control = disk.robot()
    for stamp_ns in FAR_AHEAD:
        absurd = order(stamp_ns, kind)
        assert control.take(absurd).state is MissionState.RUNNING
        control.next(True, 0.0, HOME)
        control.follow(status(finished=over))
    for later in (order(1, MissionKind.STOP, "halt"), order(2, MissionKind.EXPLORE, "on")):
        assert control.take(later).state is MissionState.RUNNING
        assert control.take(order(0, MissionKind.EXPLORE, "late")).state is MissionState.REPLACED
        for robot in (control, disk.robot()):
            assert robot.report is not None and robot.report.order == later
            assert not robot.take(absurd).open, "twice is once"
            assert robot.report.order == later
            assert robot.next(True, 0.0, HOME) in (as_mission(later), None)


def test_the_mission_of_a_start_holds_whatever_was_kept():
    disk = Disk()
    disk.robot().take(order(MAX_STAMP_NS, MissionKind.EXPLORE))
    control = disk.robot()
    control.begin(MissionKind.STOP)
    assert control.report is not None and control.report.order.kind is MissionKind.STOP


@given(st.integers(0, MAX_STAMP_NS), st.integers(0, MAX_STAMP_NS))
def test_an_order_that_is_given_now_replaces_the_one_that_holds(now_ns: int, than_ns: int):
    """But for the last stamps that there are."""
    stamp_ns = later_stamp(now_ns, than_ns)
    assert 0 <= stamp_ns <= MAX_STAMP_NS
    if max(now_ns, than_ns) < MAX_STAMP_NS or than_ns - now_ns > MOST_APART_NS:
        assert order(stamp_ns, name="a").replaces(order(than_ns, name="b"))


def test_a_goal_that_is_known_not_to_exist_is_refused_and_the_mission_goes_on():
    control = Disk().robot()
    control.take(order(1))
    assert control.take(order(2, node=NOWHERE)) == MissionReport(
        order(2, node=NOWHERE), MissionState.REFUSED, 0.0, "no such node"
    )
    assert control.report == MissionReport(order(1), MissionState.RUNNING)


def test_the_end_is_reported_with_its_reason():
    for end, state in (
        (status(finished=True), MissionState.DONE),
        (status(given_up=True), MissionState.FAILED),
    ):
        control = Disk().robot()
        control.take(order(1))
        assert control.next(True, 0.0, None) == GoTo(GOAL)
        assert not control.follow(status(progress=0.5, why="0.4 m to node r1.1.5"))
        assert control.report == MissionReport(order(1), MissionState.RUNNING, 0.5)
        assert control.follow(end)
        assert control.report is not None and control.report.state is state
        assert control.next(True, 1.0, None) is None, "it holds its place"


def test_an_order_that_comes_during_a_tick_is_not_ended_by_what_the_one_before_has_reached():
    control = Disk().robot()
    control.take(order(1))
    control.next(True, 0.0, None)
    control.take(order(2, node=HOME))
    assert not control.follow(status(finished=True))
    assert control.report == MissionReport(order(2, node=HOME), MissionState.RUNNING)


def test_a_robot_that_is_switched_on_again_goes_on(tmp_path):
    """By the real journal: it seeks the goal that it had, and not one that it has reached."""

    def restarted(*ends: Status) -> MissionControl:
        journal = Journal(tmp_path / "r0.sqlite", "r0")
        control = MissionControl("r0", journal.missions(), journal.keep_missions)
        control.next(True, 0.0, None)
        for end in ends:
            control.follow(end)
        journal.close()
        return control

    journal = Journal(tmp_path / "r0.sqlite", "r0")
    control = MissionControl("r0", journal.missions(), journal.keep_missions)
    control.begin(MissionKind.EXPLORE)
    explored = control.report
    assert explored is not None
    control.take(order(explored.order.stamp_ns + 1))
    journal.close()
    control = restarted()
    assert control.report is not None and control.report.order.node == GOAL and control.report.open
    assert restarted(status(finished=True)).report == control.report.__class__(
        control.report.order, MissionState.DONE, 1.0
    )
    again = restarted()
    assert again.report is not None and again.report.state is MissionState.DONE
    assert again._applied == (again.report.order.id, Idle()), "it is there already, and stays"
    assert again.take(explored.order).state is MissionState.REPLACED


def test_a_robot_that_is_switched_on_again_goes_on_from_the_stop_and_the_portal_where_it_was():
    """A power failure at any moment of a drive with two stops and a lift."""
    disk, stops = Disk(), (HOME, NodeId("r0", 1, 2))
    portal = PortalWait(PortalStop("lift", PortalMeans.LIFT, HOME, GOAL, "2"))
    disk.robot().take(replace(order(1), via=stops))

    def after(*events: tuple[int, PortalWait | None], through: bool = False) -> GoTo:
        """What a new process begins with, once an old one has got so far."""
        control = disk.robot()
        control.next(True, 0.0, None)
        for passed, wait in events:
            assert control.follow(replace(status(), passed=passed, portal=wait)), "it is on the disk"
            assert not control.follow(replace(status(), passed=passed, portal=wait)), "and not again"
            assert control.next(True, 0.0, None) is None, "the drive goes on"
        if through:
            control.portal_done("anna")
        mission = disk.robot().next(True, 0.0, None)
        assert isinstance(mission, GoTo)
        return mission

    assert after() == GoTo(GOAL, stops)
    assert after((1, None)) == GoTo(GOAL, stops, 1)
    assert after((2, None), (2, portal)) == GoTo(GOAL, stops, 2, portal)
    assert after(through=True) == GoTo(GOAL, stops, 2, replace(portal, done=True))
    with pytest.raises(InvalidValue, match="r0 looks where it is already"):
        disk.robot().portal_done("bob")
    assert after((2, None)) == GoTo(GOAL, stops, 2)
    with pytest.raises(InvalidValue, match="r0 does not wait at a portal"):
        disk.robot().portal_done("bob")


def test_a_full_disk_does_not_keep_a_robot_from_stopping():
    def full(reports) -> None:
        raise InvalidFile("no space left")

    control = MissionControl("r0", keep=full)
    control.take(order(1))
    assert control.take(order(2, MissionKind.STOP)).state is MissionState.RUNNING
    assert control.next(True, 0.0, None) == Idle()


def test_an_order_for_another_robot_is_refused():
    with pytest.raises(InvalidValue, match="a mission of r0 came to r1"):
        MissionControl("r1").take(order(1))


def test_many_missions_do_not_fill_the_disk():
    control = MissionControl("r0")
    for stamp in range(MAX_KEPT + 20):
        control.take(order(stamp))
    for stamp in range(MAX_KEPT + 20, 3 * MAX_KEPT):
        control.take(order(stamp, node=NOWHERE))
    assert len(control._reports) == MAX_KEPT and control.report is not None


@pytest.mark.parametrize(("setting", "home", "does", "reason"), [
    (WithoutServer.GO_ON, HOME, None, ""),
    (WithoutServer.STAND, HOME, Idle(), "stands: no map server for 10 s"),
    (WithoutServer.HOME, HOME, GoTo(HOME), "goes home: no map server for 10 s"),
    (WithoutServer.HOME, None, Idle(), "stands: no map server for 10 s"),
])  # fmt: skip
def test_a_robot_whose_server_is_gone_does_as_it_is_set(setting, home, does, reason):
    control = Disk().robot(setting)
    control.take(order(1, MissionKind.EXPLORE))
    assert control.next(True, 0.0, home) == Explore()
    assert control.next(False, GONE, home) is None, "a router that is started again takes a moment"
    assert control.next(False, GONE + 0.1, home) == does
    control.follow(status(finished=does is not None))
    assert control.report is not None and control.report.state is MissionState.RUNNING
    assert control.report.reason == reason
    assert control.next(True, 60.0, home) == (None if does is None else Explore()), "and goes on"
    control.follow(status())
    assert control.report.reason == ""


NO_MISSION = Status("idle", "no mission; no camera", 0, 0, Pose2(), False)
DRIVING = Status("driving", "to r0.1.4", 0, 0, Pose2(), False, "goto")


@pytest.mark.parametrize(("setting", "status", "doing", "detail"), [
    (WithoutServer.STAND, NO_MISSION, "standing", "no map server for 10 s; no camera"),
    (WithoutServer.HOME, DRIVING, "driving", "goes home: no map server for 10 s; to r0.1.4"),
    (WithoutServer.GO_ON, DRIVING, "driving", "to r0.1.4"),
])  # fmt: skip
def test_a_robot_that_stands_or_goes_home_says_that_it_is_for_the_server(setting, status, doing, detail):
    control = Disk().robot(setting)
    control.take(order(1))
    control.next(True, 0.0, HOME)
    assert control.explained(DRIVING) == DRIVING
    control.next(False, GONE + 0.1, HOME)
    said = control.explained(status)
    assert (said.doing, said.detail) == (doing, detail)
    control.next(True, GONE + 0.2, HOME)
    assert control.explained(DRIVING) == DRIVING


@pytest.mark.parametrize("setting", [WithoutServer.STAND, WithoutServer.HOME])
def test_a_robot_that_was_stopped_stands_for_that_and_not_for_the_server(setting: WithoutServer):
    control = Disk().robot(setting)
    control.take(order(1, MissionKind.STOP))
    assert control.next(True, 0.0, HOME) == Idle()
    assert control.next(False, GONE + 0.1, HOME) is None, "it must not drive off by itself"
    assert control.explained(NO_MISSION) == NO_MISSION
    control.follow(NO_MISSION)
    assert control.report is not None and control.report.reason == "no mission; no camera"


def test_a_robot_that_has_parked_stays_parked_while_the_server_is_gone_and_after():
    control = Disk().robot(WithoutServer.STAND)
    control.take(order(1))
    assert isinstance(control.next(True, 0.0, HOME), GoTo)
    control.follow(status(finished=True))
    for linked, now in ((False, GONE + 0.1), (False, GONE + 0.2), (True, GONE + 0.3)):
        assert control.next(linked, now, HOME) is None, "it stands already, and knows where"


def test_a_stop_ends_the_drive_home_of_a_robot_whose_server_is_gone():
    control = Disk().robot(WithoutServer.HOME)
    control.take(order(1))
    control.next(True, 0.0, HOME)
    assert control.next(False, GONE + 0.1, HOME) == GoTo(HOME)
    control.take(order(2, MissionKind.STOP))
    assert control.next(False, GONE + 0.2, HOME) == Idle()
    control.follow(NO_MISSION)
    assert control.report is not None and control.report.state is MissionState.DONE


def test_a_recording_takes_no_orders():
    control = MissionControl("r0", refusal="a recording takes no orders")
    control.begin(MissionKind.CARRIED)
    report = control.take(order(2**62, MissionKind.STOP))
    assert (report.state, report.reason) == (MissionState.REFUSED, "a recording takes no orders")
    assert isinstance(control.next(True, 0.0, None), Carried)
    held = control.report
    assert held is not None and held.order.kind is MissionKind.CARRIED
    # Nor in the place of the mission that holds, by its id.
    again = control.take(order(2**62, MissionKind.STOP, held.order.id))
    assert again == control.report == held
