"""Missions from people to robots, and what has become of them: a relay with a record on the disk.

Robots work without it: an order may also go to an agent directly. A robot that is away gets its newest
mission when it is back.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import NodeId, check_name
from mapweave.hybridmap.mission_order import (
    MAX_KEPT,
    MAX_VIA,
    OPEN,
    MissionKind,
    MissionOrder,
    MissionReport,
    MissionRequest,
    Missions,
    MissionState,
    later_stamp,
    new_id,
)
from mapweave.hybridmap.portal import PortalDone
from mapweave.mapserver.goals import node_of_goal
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.places import PlaceResolver, others_of
from mapweave.mapserver.roster import Roster
from mapweave.storage.full_disks import logged
from mapweave.wire.bus import Bus, Reply
from mapweave.wire.each_robot import in_parallel
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, encode

log = logging.getLogger(__name__)

KEPT = "missions"
"""Among the results of the store."""
ANSWER = 2.0
"""How long a robot may take to acknowledge, s."""
EXPIRY = 600.0
"""A robot that is away for longer does not get a mission of before, s: it would drive off unexpectedly."""
MOST_AHEAD = 86_400.0
"""By which a mission may be given ahead of the server's clock, s: none comes behind the greatest stamp."""
EVERY = 1.0
"""Time between two attempts, s."""

_Key = tuple[str, str]
"""A robot and the id of a mission: what one robot reports is none of another's, whatever id it has."""


def _key(mission: MissionOrder | MissionRequest) -> _Key:
    return mission.robot, mission.id


class MissionRelay:
    """Takes missions from any thread. `hear` and `retry` are called by the server.

    Attributes:
        given: called whenever a person gives a mission, also one that is known; must not wait.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        store: Store,
        places: Callable[[], PlaceResolver],
        time_ns: Callable[[], int],
        later: Callable[[Callable[[], None]], None],
        note: Callable[[MissionOrder, bool], None] = lambda order, heard: None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """Go on with the record of the store.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            store: keeps the record.
            places: of the newest merged map.
            time_ns: the present time.
            later: has something done soon, and does not wait for it.
            note: is called with each mission once, and whether a robot has said so; must not wait.
            monotonic: a clock that only grows, s.
        """
        self._monotonic = monotonic
        self._sent_at: dict[_Key, float] = {}
        self._later, self._noted = later, note
        self._bus, self._keys, self._store, self._places, self._time_ns = bus, keys, store, places, time_ns
        self.roster: Roster | None = None
        self.given: Callable[[], None] = lambda: None
        # A commit may wait for a standby of PostgreSQL: what is known is never held up by it.
        self._turn, self._writing = threading.RLock(), threading.Lock()
        self._reports: dict[_Key, MissionReport] = {}
        self._overwritten = self._unwritten = self._write_is_due = self._write_fails = False
        self.reload()

    def reload(self) -> None:
        """Read the record, to which other servers may have added.

        What another server has written over, since it did not know of it yet, `retry` writes again.
        """
        try:
            kept = self._store.result(KEPT)
            missions = Missions() if kept is None else decode(kept, Missions)
        except InvalidMessage as error:
            log.warning("the record of missions is lost: %s", error)
            return
        with self._turn:
            for report in missions.reports:
                before = self._reports.get(_key(report.order))
                if before is None or report.supersedes(before):
                    self._reports[_key(report.order)] = report
            stored = {_key(report.order): report for report in missions.reports}
            self._overwritten = any(
                (held := stored.get(_key(report.order))) is None
                or (report.state is not held.state and report.supersedes(held))
                for report in self.missions().reports
            )

    def close(self) -> None:
        """Write what is not written yet."""
        self._write()

    def missions(self) -> Missions:
        """All that are known, oldest first."""
        with self._turn:
            return Missions.newest(list(self._reports.values()))

    def command(self, request: MissionRequest) -> MissionReport:
        """Take a mission of a person; see `hand_on`."""
        self.given()
        return self.hand_on(request)

    def hand_on(self, request: MissionRequest) -> MissionReport:
        """Hand a mission on to its robot; returns what has become of it. It waits for the robot's answer.

        Raises:
            InvalidValue: there is no such robot, or the mission is of a time that is far ahead.
        """
        with self._turn:
            known = self._reports.get(_key(request))
        # In lock-step the server's time is the simulator's, and a person's is not.
        ahead = (request.stamp_ns - max(self._time_ns(), time.time_ns())) * 1e-9
        if known is None and ahead > MOST_AHEAD:
            days = f"{ahead / 86_400:.0f} days"
            raise InvalidValue(f"mission {request.id} is given {days} ahead of the server's clock")
        if known is not None and known.state is not MissionState.SENT:
            return known
        if known is None:
            known = self._note(self._resolved(request))
            self._replace_older(known.order, MissionState.SENT)
        return self._hand_on(known.order) if known.open else known

    def portal_done(self, robot: str, by: str) -> str:
        """Tell a robot that it was taken through a portal; returns what it does, in words.

        Raises:
            InvalidValue: it does not wait at a portal, or does not answer.
        """
        done = PortalDone(check_name(robot), by[:64])
        for reply in self._bus.ask(self._keys.portal(robot), encode(done), ANSWER):
            if reply.error:
                raise InvalidValue(reply.error.removeprefix("refused: "))
            return str(decode_record(reply.payload)["said"])
        raise InvalidValue(f"{robot} does not answer")

    def request(
        self,
        robot: str,
        kind: MissionKind,
        goal: str,
        by: str,
        mission_id: str = "",
        via: tuple[str, ...] = (),
        because: str = "",
    ) -> MissionRequest:
        """A mission that is given now, and is newer than the one that holds the robot or waits for it.

        Raises:
            InvalidValue: the goal is missing or too long, or there is one too many; a name is none.
        """
        status = None if self.roster is None else self.roster.status(robot)
        report = None if status is None else status.mission
        with self._turn:
            given = [
                one.order.stamp_ns
                for one in self._reports.values()
                if one.order.robot == robot and one.state is MissionState.SENT
            ]
        holding = 0 if report is None else report.order.stamp_ns
        stamp_ns = later_stamp(self._time_ns(), max([holding, *given]))
        mission_id = check_name(mission_id) if mission_id else new_id()
        if len(via) > MAX_VIA:
            raise InvalidValue(f"a mission passes at most {MAX_VIA} places, not {len(via)}")
        return MissionRequest(mission_id, check_name(robot), kind, stamp_ns, by[:64], goal, via, because)

    def hear(self, status: AgentStatus) -> None:
        """Take note of what a robot reports of its mission."""
        report = status.mission
        # That one is on its way only the server can say: it would try to hand it on.
        if report is None or report.state is MissionState.SENT:
            return
        self._take(report, heard=True)
        self._take_replaced(report.order)
        with self._turn:
            if not self._unwritten or self._write_is_due:
                return
            self._write_is_due = True
        # This is called where questions of lost robots are taken.
        self._later(self._write)

    def retry(self) -> None:
        """Try to hand on what robots could not be reached for, and write what is not in the record."""
        with self._turn:
            self._unwritten |= self._overwritten
            waiting = [report for report in self._reports.values() if report.state is MissionState.SENT]
        self._write()
        orders: list[MissionOrder] = []
        now, known = self._monotonic(), self._sent_at
        self._sent_at = {_key(report.order): known.get(_key(report.order), now) for report in waiting}
        for report in waiting:
            robot, age = report.order.robot, (self._time_ns() - report.order.stamp_ns) * 1e-9
            # A clock that was put back, or a person's that is ahead, makes a mission last no longer.
            if max(age, now - self._sent_at[_key(report.order)]) > EXPIRY:
                reason = f"{robot} did not answer within {EXPIRY:g} s"
                self._note(replace(report, state=MissionState.FAILED, reason=reason))
            elif self.roster is not None and self.roster.alive(robot):
                orders.append(report.order)
        # All at once: one that hangs keeps no other from its mission.
        for order, replies in zip(orders, in_parallel(orders, self._give), strict=True):
            self._answered(order, replies)

    def _resolved(self, request: MissionRequest) -> MissionReport:
        """The mission as the robot gets it, or refused."""
        robot, node = request.robot, None
        via: tuple[NodeId, ...] = ()
        # Its last status may be of the map before, and a server that has just begun has none.
        map_id = None if self.roster is None else self.roster.map_of(robot)
        if map_id is None:
            heard = () if self.roster is None else tuple(self.roster.presence())
            raise InvalidValue(f"no robot {robot} has been heard of{others_of(robot, heard)}")
        if request.goal:
            places = self._places()
            node = node_of_goal(request.goal, map_id, places)
            via = tuple(node_of_goal(word, map_id, places, "via point") for word in request.via)
        order = MissionOrder(
            request.id, robot, request.kind, request.stamp_ns, request.by, node, request.goal, via,
            request.because,
        )  # fmt: skip
        return MissionReport(order, MissionState.SENT)

    def _replace_older(self, order: MissionOrder, *states: MissionState) -> None:
        """See `_take_replaced`; it is on the disk then."""
        self._take_replaced(order, *states)
        self._write()

    def _take_replaced(self, order: MissionOrder, *states: MissionState) -> None:
        """A robot's mission ends those that it replaces, of these states or of all that are open."""
        with self._turn:
            older = [
                report
                for report in self._reports.values()
                if report.state in (states or OPEN)
                and report.order.robot == order.robot
                and order.replaces(report.order)
            ]
        for report in older:
            reason = f"by mission {order.id} of {order.by}"
            self._take(replace(report, state=MissionState.REPLACED, reason=reason))

    def _hand_on(self, order: MissionOrder) -> MissionReport:
        return self._answered(order, self._give(order))

    def _give(self, order: MissionOrder) -> Sequence[Reply]:
        return self._bus.ask(self._keys.mission(order.robot), encode(order), ANSWER)

    def _answered(self, order: MissionOrder, replies: Sequence[Reply]) -> MissionReport:
        """Note what a robot has answered to an order; no reply: it may be away."""
        for reply in replies:
            if reply.error:
                return self._note(MissionReport(order, MissionState.REFUSED, 0.0, reply.error))
            try:
                said = decode(reply.payload, MissionReport)
                if (said.order.id, said.order.robot) != (order.id, order.robot):
                    raise InvalidMessage(f"{order.robot} answers with the report of another mission")
                report = self._note(said)
            except InvalidMessage as error:
                return self._note(MissionReport(order, MissionState.REFUSED, 0.0, str(error)))
            if report.state is MissionState.RUNNING:
                self._replace_older(order)
            return report
        reason = f"{order.robot} does not answer: it gets the mission when it is back within {EXPIRY:g} s"
        return self._note(MissionReport(order, MissionState.SENT, 0.0, reason))

    def _note(self, report: MissionReport) -> MissionReport:
        """See `_take`; what is new is on the disk then."""
        taken = self._take(report)
        self._write()
        return taken

    def _take(self, report: MissionReport, heard: bool = False) -> MissionReport:
        """Keep a report, to be written if the state is new; returns what holds.

        Args:
            report: of a mission.
            heard: whether it is the robot's word alone.

        Raises:
            InvalidValue: no message may hold it.
        """
        # Before it is kept: with it the whole record could be neither written nor sent, and no robot stopped.
        encode(report)
        with self._turn:
            before = self._reports.get(_key(report.order))
            if before is not None and not report.supersedes(before):
                return before
            if before is not None:
                # A robot says what has become of an order, and not what was ordered, or by whose name.
                report = replace(report, order=before.order)
            self._reports[_key(report.order)] = report
            if before is None:
                self._noted(report.order, heard)
            if before is None or before.state is not report.state:
                self._unwritten = True
                if len(self._reports) > MAX_KEPT:
                    self._reports = {_key(one.order): one for one in self.missions().reports}
            return report

    def _write(self) -> None:
        """Write the record if there is anything new; where that fails, `retry` writes it again."""
        with self._writing:
            with self._turn:
                self._write_is_due = False
                if not self._unwritten:
                    return
                kept, self._unwritten, self._overwritten = self.missions(), False, False
            try:
                self._store.put_result(KEPT, encode(kept))
            except InvalidFile as error:
                if not logged(error) and not self._write_fails:
                    log.warning("the record of missions is not on the disk, and is tried again: %s", error)
                with self._turn:
                    self._unwritten = self._write_fails = True
            else:
                if self._write_fails:
                    log.info("the record of missions is on the disk again")
                self._write_fails = False
