"""A running fleet, from Python: its merged map, who is doing what, missions, events.

with mapweave.connect("tcp/127.0.0.1:7447") as fleet:
    for robot in fleet.status().robots:
        print(robot.robot, robot.status.status.doing)
    fleet.go("r0", "r1.1.5", wait=120.0)
    fleet.plot()
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, overload

from mapweave.connection import ANSWERED, reach
from mapweave.fleet_map import FleetMap
from mapweave.hybridmap.agent_status import SILENT, AgentStatus, FleetStatus, RobotEntry
from mapweave.hybridmap.errors import InvalidValue, MapweaveError, NotConnected, Refused
from mapweave.hybridmap.ids import NodeId, check_name
from mapweave.hybridmap.mission_order import (
    MAX_KEPT,
    MissionKind,
    MissionOrder,
    MissionReport,
    MissionRequest,
    Missions,
    MissionState,
    later_stamp,
    new_id,
)
from mapweave.hybridmap.named_nodes import NodeWord, word_of
from mapweave.hybridmap.portal import PortalDone
from mapweave.identities.key_file import read_key_file
from mapweave.login import login
from mapweave.refusals import listed
from mapweave.wire.bus import Bus, Sample
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.each_robot import alive_robots, each_robot, in_parallel
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus

if TYPE_CHECKING:
    from mapweave.mapserver.plan_answers import StatusOnPlan

TRIES = 3
"""A mission given by a clock that is behind is given again, later than the robot's present one."""


class Silent(NotConnected):
    """A robot does not answer."""


def connect(
    endpoint: str | Sequence[str] = "tcp/127.0.0.1:7447",
    fleet: str = "demo",
    by: str = "",
    keys: str | Path = "",
) -> Fleet:
    """Connect to a running fleet; see Fleet.

    Raises:
        NotConnected: there is no router.
    """
    return Fleet(endpoint, fleet, by, keys)


def send_order(
    bus: Bus, keys: Keys, order: MissionOrder, timeout: float = 10.0, sender: str = ""
) -> MissionReport:
    """Give a robot an order directly; returns what has become of it.

    Args:
        bus: the connection.
        keys: of the fleet.
        order: the mission.
        timeout: longest wait, s.
        sender: holder of the key with which the bus is connected; empty without one.

    Raises:
        Silent: the robot does not answer.
        NotConnected: it does not take it.
    """
    replies = bus.ask(sent_by(keys.mission(order.robot), sender), encode(order), timeout)
    if not replies:
        raise Silent(
            f"robot {order.robot} does not answer: is its agent running? `mapweave status` lists the robots"
        )
    if replies[0].error:
        raise NotConnected(f"robot {order.robot} did not take its mission: {replies[0].error}")
    return decode(replies[0].payload, MissionReport)


def send_portal_done(bus: Bus, keys: Keys, done: PortalDone, timeout: float = 10.0, sender: str = "") -> str:
    """Tell a robot directly that it was taken through a portal; returns what it does, in words.

    Raises:
        NotConnected: it does not answer.
        Refused: it does not wait at a portal.
    """
    replies = bus.ask(sent_by(keys.portal(done.robot), sender), encode(done), timeout)
    if not replies:
        raise NotConnected(
            f"robot {done.robot} does not answer: is its agent running? `mapweave status` lists the robots"
        )
    if replies[0].error:
        raise Refused(replies[0].error.removeprefix("refused: "))
    return str(decode_record(replies[0].payload)["said"])


def author(holder: Credentials | None, by: str) -> str:
    """Who commands and corrects, for records.

    Args:
        holder: of the key with which one is connected, if there is one: the server records this name.
        by: the name that the person gives; empty: the login name.

    Raises:
        InvalidValue: it is not the holder's.
    """
    if holder is None:
        return by or login()
    if by not in ("", holder.name):
        raise InvalidValue(f"with this key you are {holder.name}, not {by}: leave the name out")
    return holder.name


class Fleet(FleetMap):
    """A connection to a fleet, and its merged map. A context manager; it may be used from any thread.

    The merged map is fetched when it is first looked at, and again by `refresh`. Whereabouts, routes and
    explanations are the map server's, so they are of its newest map and need no extra here.
    """

    def __init__(
        self,
        connect: str | Sequence[str] = "tcp/127.0.0.1:7447",
        fleet: str = "demo",
        by: str = "",
        keys: str | Path = "",
        bus: Bus | None = None,
    ) -> None:
        """Connect.

        Args:
            connect: Zenoh endpoint of the router, or several, of which the first in reach is taken.
            fleet: its name.
            by: gives the missions; the login name by default, with a key the name of its holder.
            keys: key file of an operator or viewer, where the router asks for one.
            bus: a connection to use instead; it stays the caller's.

        Raises:
            NotConnected: there is no router.
        """
        checked = Keys(check_name(fleet))
        self._key_holder = read_key_file(Path(keys)).credentials if keys else None
        self._by = author(self._key_holder, by)[:64]
        # Final reports that the map server may not have heard of yet, by robot and id.
        self._finished: dict[tuple[str, str], MissionReport] = {}
        self._own: ZenohBus | None = None
        if bus is None:
            endpoints = (connect,) if isinstance(connect, str) else tuple(connect)
            bus = self._own = reach(BusSettings(endpoints=endpoints, credentials=self._key_holder))
        super().__init__(bus, checked)

    def __enter__(self) -> Fleet:
        """Nothing more to do."""
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.close()

    def close(self) -> None:
        """Disconnect. Idempotent."""
        self._closed = True
        if self._own is not None:
            self._own.close()

    @overload
    def status(self, plan: None = None) -> FleetStatus: ...
    @overload
    def status(self, plan: str) -> StatusOnPlan: ...

    def status(self, plan: str | None = None) -> FleetStatus:
        """All robots, as the map server sees them; without one, those that answer themselves.

        Args:
            plan: a floor plan, in whose frame each robot then has `plan_from_robot`.

        Raises:
            NotConnected: no map server and no robot answers.
            Refused: there is no such plan.
        """
        if plan is not None:
            from mapweave.mapserver.plan_answers import status_on_plan

            return status_on_plan(self._status(), self.plans().plan(plan))
        return self._status()

    def _status(self) -> FleetStatus:
        for reply in self._ask(self._keys.any_robots(), b"", ANSWERED):
            return decode(reply.payload, FleetStatus)
        replies = self._ask(self._keys.agent_statuses(), b"", ANSWERED)
        if not replies and self._key_holder is not None:
            # A router with keys passes a question to a robot only if it is for that one alone.
            keys = [self._keys.agent_status(name) for name in alive_robots(self._bus, self._keys)]
            asked = in_parallel(keys, lambda key: self._ask(key, b"", ANSWERED))
            replies = [reply for one in asked for reply in one]
        robots = []
        for reply in replies:
            status = decode(reply.payload, AgentStatus)
            robots.append(RobotEntry(status.robot, True, 0.0, status))
        if not robots:
            raise self._no_answer()
        return FleetStatus(tuple(sorted(robots, key=lambda entry: entry.robot)))

    def missions(self, robot: str = "") -> tuple[MissionReport, ...]:
        """The missions that the map server knows of, or those of one robot, oldest first; none is in an older
        state than `wait` has returned.

        Raises:
            NotConnected: no map server answers.
            Refused: no such robot was ever heard of.
        """
        relayed = decode(self._question(self._keys.any_missions(), b"", ANSWERED), Missions).reports
        reports = (self._finished.get(_key(one), one) if one.open else one for one in relayed)
        found = tuple(report for report in reports if robot in ("", report.order.robot))
        if robot and not found:
            known = [entry.robot for entry in self.status().robots]
            if robot not in known:
                raise Refused(f"there is no robot {robot}; there are: {', '.join(known) or 'none'}")
        return found

    def go(
        self,
        robot: str,
        goal: NodeWord,
        wait: float = 0.0,
        via: Iterable[NodeWord] = (),
        plan: str | None = None,
        because: str = "",
    ) -> MissionReport:
        """Send a robot to a node (`r0.1.17`), a place, a position in the merged map or `home`.

        Args:
            robot: which.
            goal: where to.
            wait: until it is there or has given up, s at most.
            via: what to pass before, in order, in the same words.
            plan: a floor plan, in whose frame positions are then, instead of in the merged map.
            because: why, for the history.

        Raises:
            InvalidValue: `via` is one place, and no list.
            Refused: the robot or the goal does not exist, or no way leads there.
            NotConnected: the robot does not answer.
        """
        words = tuple(map(word_of, (goal, *listed("via", via))))
        if plan is not None:
            from mapweave.mapserver.plan_answers import component_of, goal_on_plan

            placed, component = self.plans().plan(plan), component_of(robot, self.status())
            words = tuple(goal_on_plan(word, placed, component, self.resolve) for word in words)
        return self._give(robot, MissionKind.GO, words[0], wait, words[1:], because)

    def explore(self, robot: str, wait: float = 0.0, because: str = "") -> MissionReport:
        """Let a robot map all floor that it can reach; see `go`."""
        return self._give(robot, MissionKind.EXPLORE, "", wait, because=because)

    def carried(self, robot: str, because: str = "") -> MissionReport:
        """Let a robot map while a person moves it; see `go`."""
        return self._give(robot, MissionKind.CARRIED, "", 0.0, because=because)

    def stop(self, robot: str = "", because: str = "") -> tuple[MissionReport, ...]:
        """Stop a robot, or all of them; the orders go to the robots directly, and at once.

        Where a robot does not answer, the map server gets the order (state SENT): it gives the robot no
        mission of before any more, and the stop once it is back.

        Args:
            robot: which; without a name all that are there, and all that wait for a mission.
            because: why, for the history.

        Raises:
            NotConnected: one does not answer and no map server knows it, or it does not answer as it should;
                the others are stopped.
        """
        self._check_role()
        if robot:
            return tuple(each_robot([check_name(robot)], lambda name: self._stop(name, because)))
        there = [entry.robot for entry in self.status().robots if entry.alive]
        try:
            stopped = each_robot(there, lambda name: self._stop(name, because))
        finally:
            # Those that drive wait for no server's answer about the others.
            names = sorted(self._awaited().difference(there))
            away = each_robot(names, lambda name: self._stop(name, because))
        return (*stopped, *away)

    def portal_done(self, robot: str) -> str:
        """Tell a robot that it was taken through the portal at which it waits; it looks where it is then.

        Returns:
            What it does, in words.

        Raises:
            NotConnected: it does not answer.
            Refused: it does not wait at a portal.
        """
        self._check_role()
        done = PortalDone(check_name(robot), self._by)
        return send_portal_done(self._bus, self._keys, done, sender=self._sender)

    def wait(
        self,
        mission: MissionReport,
        seconds: float,
        on_report: Callable[[MissionReport, AgentStatus], None] = lambda report, status: None,
        on_silence: Callable[[float], None] = lambda silent: None,
    ) -> MissionReport:
        """Wait until a mission is over; returns its last report, which is open if the time is over first.

        The map server hears meanwhile that an operator is there, see `[attendance]` of its settings.

        Args:
            mission: as it was given.
            seconds: at most.
            on_report: called with each status of the robot.
            on_silence: called, again and again, with for how long nothing has been heard of the robot, s, if
                that is more than `SILENT`. It may come back: missions survive a restart of its agent.
        """
        order, over = mission.order, threading.Event()
        last, heard = [mission], [time.monotonic()]

        def hear(sample: Sample) -> None:
            heard[0] = time.monotonic()
            status = decode(sample.payload, AgentStatus)
            report = status.mission
            if report is None:
                return
            if report.order.id == order.id:
                last[0] = report
                on_report(report, status)
            elif report.order.rank > order.rank:
                reason = f"by mission {report.order.id} of {report.order.by}"
                last[0] = replace(last[0], state=MissionState.REPLACED, reason=reason)
            if not last[0].open:
                over.set()

        listening = self._bus.subscribe(self._keys.agent_status(order.robot), hear)
        try:
            end = time.monotonic() + seconds
            while mission.open and not over.wait(min(SILENT, max(end - time.monotonic(), 0.0))):
                if (now := time.monotonic()) >= end:
                    break
                self._attend(order)
                if now - heard[0] > SILENT:
                    on_silence(now - heard[0])
        finally:
            listening.close()
        if not last[0].open:
            while len(self._finished) >= MAX_KEPT:
                self._finished.pop(next(iter(self._finished)), None)
            self._finished[_key(last[0])] = last[0]
        return last[0]

    def _attend(self, order: MissionOrder) -> None:
        """Give a mission again, by which the map server knows that someone waits for it."""
        if self._key_holder is not None and self._key_holder.role is not Role.OPERATOR:
            return
        goal = "" if order.node is None else order.goal or str(order.node)
        request = MissionRequest(
            order.id, order.robot, order.kind, order.stamp_ns, order.by, goal, tuple(map(str, order.via)),
            order.because,
        )  # fmt: skip
        self._bus.ask(sent_by(self._keys.any_mission(), self._sender), encode(request), ANSWERED)

    def _give(
        self,
        robot: str,
        kind: MissionKind,
        goal: str,
        wait: float,
        via: tuple[str, ...] = (),
        because: str = "",
        after_ns: int = 0,
    ) -> MissionReport:
        """Give a mission by way of the map server, later than the stamp; without one directly."""
        check_name(robot)
        self._check_role()
        report = None
        for _ in range(TRIES):
            stamp_ns = later_stamp(time.time_ns(), after_ns)
            request = MissionRequest(new_id(), robot, kind, stamp_ns, self._by, goal, via, because)
            key = sent_by(self._keys.any_mission(), self._sender)
            replies = self._bus.ask(key, encode(request), 2.0 * ANSWERED)
            taken = [reply for reply in replies if not reply.error]
            if not taken and replies:
                raise Refused(replies[0].error.removeprefix("refused: "))
            if not taken:
                nodes = tuple(node for word in via if (node := _node(word, "via point")) is not None)
                report = self._direct(robot, kind, _node(goal), goal, nodes, because)
                break
            report = decode(taken[0].payload, MissionReport)
            if report.state is not MissionState.REPLACED:
                break
            after_ns = self._newest(robot)
        assert report is not None, "it was tried"
        return self.wait(report, wait) if wait > 0.0 else report

    def _direct(
        self,
        robot: str,
        kind: MissionKind,
        node: NodeId | None,
        goal: str,
        via: tuple[NodeId, ...] = (),
        because: str = "",
    ) -> MissionReport:
        after_ns = 0
        for _ in range(TRIES):
            order = MissionOrder.new(robot, kind, self._by, node, after_ns)
            order = replace(order, goal=goal, via=via, because=because)
            report = send_order(self._bus, self._keys, order, ANSWERED, self._sender)
            if report.state is not MissionState.REPLACED:
                break
            after_ns = self._newest(robot)
        return report

    def _awaited(self) -> set[str]:
        """The robots that a map server would give a mission once they are back; without a server none."""
        names: set[str] = set()
        for reply in self._bus.ask(self._keys.any_missions(), b"", ANSWERED):
            if not reply.error:
                names |= decode(reply.payload, Missions).awaited()
        return names

    def _stop(self, robot: str, because: str) -> MissionReport:
        """Stop a robot, directly; one that does not answer by way of the map server."""
        try:
            return self._direct(robot, MissionKind.STOP, None, "", (), because)
        except Silent as silent:
            try:
                after_ns = max((report.order.stamp_ns for report in self.missions(robot)), default=0)
            except MapweaveError:
                raise silent from None
            return self._give(robot, MissionKind.STOP, "", 0.0, because=because, after_ns=after_ns)

    def _newest(self, robot: str) -> int:
        """Stamp of the mission that holds a robot."""
        for reply in self._ask(self._keys.agent_status(robot), b"", ANSWERED):
            report = decode(reply.payload, AgentStatus).mission
            return 0 if report is None else report.order.stamp_ns
        return 0


def _key(report: MissionReport) -> tuple[str, str]:
    return report.order.robot, report.order.id


def _node(goal: str, name: str = "goal") -> NodeId | None:
    try:
        return NodeId.parse(goal) if goal else None
    except InvalidValue:
        advice = "without a map server give a node, r0.1.17 for example"
        raise InvalidValue(f"{name} {goal!r}: {advice}") from None
