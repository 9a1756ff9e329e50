"""Which mission holds: orders in, from any sender and in any order; what the pipeline shall do out.

Orders may come twice, late, or never. The same id is the same mission; of two the newer holds, unless their
stamps are too far apart; what is over stays over. All of it is on the disk before it is acknowledged, so a
robot that was switched off goes on.
"""

import logging
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from mapweave.agent.mission import Carried, Explore, GoTo, Idle, Mission
from mapweave.agent.settings import WithoutServer
from mapweave.hybridmap.agent_status import Status, one_line
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import (
    AT_START,
    MAX_KEPT,
    MissionKind,
    MissionOrder,
    MissionReport,
    MissionState,
)

log = logging.getLogger(__name__)

GONE = 10.0
"""A server that is out of reach for so long is gone, s: a router that is started again is back by then."""
MAPPING = (MissionKind.EXPLORE, MissionKind.CARRIED)
NEVER_HOLDS = (MissionState.REFUSED, MissionState.REPLACED)
"""States of missions that no longer hold, whatever their stamp."""

Keep = Callable[[Sequence[MissionReport]], None]
Defer = Callable[[Callable[[], None]], object]


def as_mission(order: MissionOrder) -> Mission:
    """What the pipeline shall do, from the beginning."""
    if order.node is not None:
        return GoTo(order.node, order.via)
    plain: dict[MissionKind, Mission] = {MissionKind.EXPLORE: Explore(), MissionKind.CARRIED: Carried()}
    return plain.get(order.kind, Idle())


def _taken_up(mission: Mission, report: MissionReport) -> Mission:
    """The same mission from where the robot was with it."""
    return (
        replace(mission, passed=report.passed, portal=report.portal) if isinstance(mission, GoTo) else mission
    )


class MissionControl:
    """Missions of one robot. Orders come from any thread; the robot's loop calls `next` and `follow`.

    Attributes:
        unknown_goal: says of a node why the robot knows that there is none; empty if there may be. Called
            from any thread.
    """

    def __init__(
        self,
        robot: str,
        kept: Iterable[MissionReport] = (),
        keep: Keep = lambda reports: None,
        alone: WithoutServer = WithoutServer.GO_ON,
        defer: Defer = lambda save: save(),
        refusal: str = "",
    ) -> None:
        """Go on with what was kept.

        Args:
            robot: its name.
            kept: reports from the disk.
            keep: puts reports on the disk.
            alone: what the robot does while no server is in reach.
            defer: calls a function, at once or in another thread: the robot's loop, which calls `follow`,
                must not wait for the disk.
            refusal: why no orders are taken; empty if they are.
        """
        self.unknown_goal: Callable[[NodeId], str] = lambda node: ""
        self._robot = robot
        self._keep = keep
        self._alone, self._defer, self._refusal = alone, defer, refusal
        # The robot's loop waits for the first of these, and never for the second.
        self._lock, self._saving = threading.Lock(), threading.Lock()
        self._unsaved: list[MissionReport] = []
        self._reports = {report.order.id: report for report in kept}
        ranked = sorted(self._reports.values(), key=lambda report: report.order.rank)
        held = [report for report in ranked if report.state not in NEVER_HOLDS]
        self._current: str | None = held[-1].order.id if held else None
        if held and held[-1].order.kind in MAPPING:
            # There may be more to map.
            self._reports[held[-1].order.id] = replace(held[-1], state=MissionState.RUNNING)
        self._applied: tuple[str, Mission] | None = None
        self._through = False
        self._linked_at: float | None = None
        self._interruption = ""

    @property
    def report(self) -> MissionReport | None:
        """Report on the mission that holds."""
        with self._lock:
            return None if self._current is None else self._reports[self._current]

    def begin(self, kind: MissionKind) -> None:
        """Take the mission with which the agent is started: it is newer than what was kept."""
        report = self.report
        newest = 0 if report is None else report.order.stamp_ns
        with self._lock:
            self._taken(MissionOrder.new(self._robot, kind, AT_START, after_ns=newest))
        self.save()

    def take(self, order: MissionOrder) -> MissionReport:
        """Take an order; returns what has become of it.

        Raises:
            InvalidValue: it is another robot's.
        """
        if order.robot != self._robot:
            raise InvalidValue(f"a mission of {order.robot} came to {self._robot}")
        with self._lock:
            if self._refusal and order.id not in self._reports:
                report = self._note(MissionReport(order, MissionState.REFUSED, 0.0, self._refusal))
            else:
                report = self._taken(order)
        self.save()
        return report

    def _taken(self, order: MissionOrder) -> MissionReport:
        known = self._reports.get(order.id)
        if known is not None:
            return known
        current = None if self._current is None else self._reports[self._current]
        if current is not None and not order.replaces(current.order):
            newer = f"mission {current.order.id} by {current.order.by} is newer"
            return self._note(MissionReport(order, MissionState.REPLACED, 0.0, newer))
        for node in () if order.node is None else (*order.via, order.node):
            if reason := self.unknown_goal(node):
                return self._note(MissionReport(order, MissionState.REFUSED, 0.0, reason))
        report = MissionReport(order, MissionState.RUNNING)
        by = f"by mission {order.id} of {order.by}"
        replaced = [
            replace(one, state=MissionState.REPLACED, reason=by)
            for one in self._reports.values()
            # What was over is marked as well if its stamp is ahead: it must not hold after a restart.
            if (one is current and one.open) or (one.order.rank > order.rank and one.state not in NEVER_HOLDS)
        ]
        self._current = order.id
        return self._note(*replaced, report)

    def next(self, linked: bool, now: float, home: NodeId | None) -> Mission | None:
        """What the pipeline shall do from now on; None if it goes on.

        Args:
            linked: whether the server is in reach.
            now: s.
            home: where the robot goes home to, if it has a home yet.
        """
        if linked or self._linked_at is None or now < self._linked_at:  # or its clock has jumped back
            self._linked_at = now
        with self._lock:
            report = None if self._current is None else self._reports[self._current]
            if report is None:
                return None
            order = report.order
            wanted = ordered = as_mission(order) if self._active(order) else Idle()
            # A stop holds: a robot that a person has stopped must not drive off by itself.
            stays = order.kind is MissionKind.STOP or isinstance(wanted, Carried)
            gone = now - self._linked_at > GONE and not stays
            self._interruption = ""
            if gone and self._alone is WithoutServer.HOME and home is not None:
                wanted, self._interruption = GoTo(home), f"goes home: no map server for {GONE:g} s"
            elif gone and self._alone is not WithoutServer.GO_ON and report.open:
                # A robot that is done stands already, and as one that is parked it knows where.
                wanted, self._interruption = Idle(), f"stands: no map server for {GONE:g} s"
            if wanted == ordered:
                self._interruption = ""
            if (order.id, wanted) == self._applied:
                return None
            self._applied = order.id, wanted
            return _taken_up(wanted, report) if wanted == as_mission(order) else wanted

    def portal_done(self, by: str) -> str:
        """The robot was taken through the portal at which it waits, from any thread; returns that in words.

        Raises:
            InvalidValue: it waits at none.
        """
        with self._lock:
            report = None if self._current is None else self._reports[self._current]
            wait = None if report is None or not report.open else report.portal
            if report is None or wait is None or wait.done:
                what = "looks where it is already" if wait is not None else "does not wait at a portal"
                raise InvalidValue(f"{self._robot} {what}")
            self._note(replace(report, portal=replace(wait, done=True)))
            self._through = True
        self.save()
        log.info("%s was taken through %s, says %s", self._robot, wait.portal.title, by or "a person")
        return f"{self._robot} was taken through {wait.portal.title}: it looks where it is"

    def taken_through(self) -> bool:
        """Whether a person has said since the last call that the robot was taken through a portal."""
        with self._lock:
            through, self._through = self._through, False
        return through

    def follow(self, status: Status) -> bool:
        """Take note of how far the pipeline is with what `next` gave.

        Returns:
            Whether that ended it, or a further stop on its way was passed, or it came to a portal.
        """
        with self._lock:
            report = None if self._current is None else self._reports[self._current]
            if report is None or report.state is not MissionState.RUNNING:
                return False
            if self._applied != (report.order.id, as_mission(report.order)):
                self._reports[report.order.id] = replace(report, reason=self._interruption)
                return False
            before = report.passed, report.portal
            report = replace(
                report, progress=status.progress, reason="", passed=status.passed, portal=status.portal
            )
            if status.given_up:
                report = replace(report, state=MissionState.FAILED, reason=one_line(status.detail))
            elif status.finished or report.order.kind is MissionKind.STOP:
                report = replace(
                    report, state=MissionState.DONE, progress=1.0, reason=one_line(status.detail)
                )
            if report.state is MissionState.RUNNING and before == (report.passed, report.portal):
                self._reports[report.order.id] = report
                return False
            self._note(report)
        self._defer(self.save)
        return True

    def explained(self, status: Status) -> Status:
        """The status for others: also why the robot does something else than its mission says."""
        with self._lock:
            what, _, why = self._interruption.partition(": ")
        if not what:
            return status
        if status.doing != "idle":
            return replace(
                status, detail="; ".join(part for part in (f"{what}: {why}", status.detail) if part)
            )
        # The first words are that there is no mission.
        _, _, more = status.detail.partition("; ")
        return replace(status, doing="standing", detail="; ".join(part for part in (why, more) if part))

    def _active(self, order: MissionOrder) -> bool:
        """Whether the pipeline is still to do it. A goal that was reached is held, and not sought again."""
        applied = self._applied == (order.id, as_mission(order))
        return self._reports[order.id].open or order.kind in MAPPING or applied

    def _note(self, *reports: MissionReport) -> MissionReport:
        """Take note of reports, which are to be saved; returns the last."""
        self._reports.update({report.order.id: report for report in reports})
        while len(self._reports) > MAX_KEPT:
            others = (report.order for report in self._reports.values() if report.order.id != self._current)
            del self._reports[min(others, key=lambda order: order.rank).id]
        self._unsaved += reports
        return reports[-1]

    def save(self) -> None:
        """Put on the disk what is not there yet. Waits for it, and for another thread that saves."""
        with self._saving:
            with self._lock:
                reports, self._unsaved = self._unsaved, []
            if not reports:
                return
            try:
                self._keep(reports)
            except InvalidFile as error:
                # A robot must obey a stop, also with a full disk.
                log.warning("mission %s is not on the disk: %s", reports[-1].order.id, error)
