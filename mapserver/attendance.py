"""Whether an operator is there, and what robots do once none is: what `[attendance]` says.

An operator is there while a page is open whose person may command robots, and whenever someone gives a
mission, or gives the same one again, as `mapweave go --wait` does until it ends. It is not asked who gave
which mission: as long as one operator is there, all missions go on.

The rule has no memory but one time: whichever mission of a person is open while no operator is there is
ended. So it holds as well for a robot that was out of reach meanwhile, and a server that starts again waits
again.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.mission_order import AT_START, MissionKind, MissionReport
from mapweave.storage.full_disks import logged
from mapweave.wire.each_robot import in_parallel

# Settings are read before large libraries are.
if TYPE_CHECKING:
    from mapweave.mapserver.log.store import Store
    from mapweave.mapserver.mission_relay import MissionRelay

log = logging.getLogger(__name__)

ATTENDED = "attended"
"""Among the results of a store that servers share: written while an operator is there."""
EVERY = 1.0
"""Time between two looks, s."""
SAID_EVERY = 3.0
"""s between two words to other servers; well below the shortest grace."""
LEAST_GRACE = 10.0
"""s. A page that has lost its server tries again after 8 s at the latest."""
ENDED = (MissionKind.GO, MissionKind.EXPLORE)
"""Kinds that end. A robot that is carried has a person beside it."""


class Unattended(StrEnum):
    """What robots do that a person has sent, once no operator is there."""

    GO_ON = "go on"
    STAND = "stand"
    HOME = "home"
    """They park at the first node of their maps."""


@dataclass(frozen=True)
class AttendanceSettings:
    """What robots do once no operator is there.

    Attributes:
        unattended: what robots do that a person has sent: "go on", "stand", or go "home", to the first node
            of their maps. Their missions end then. Robots that explore by themselves go on in any case.
        grace: for how long no operator may be there before, s: a page that is loaded again takes some, and
            a shell that does not wait for its mission has no more.
    """

    unattended: Unattended = Unattended.GO_ON
    grace: Annotated[float, Meta(ge=LEAST_GRACE)] = 30.0

    @property
    def words(self) -> str:
        """What people at the page should know; empty if nothing happens."""
        if self.unattended is Unattended.GO_ON:
            return ""
        what = "stand" if self.unattended is Unattended.STAND else "go home"
        return f"Robots that were sent {what} {self.grace:g} s after the last operator's page was closed."


class Attendance:
    """Of one server. `attend` may be called from any thread, and never waits."""

    def __init__(
        self,
        settings: AttendanceSettings,
        name: str,
        relay: MissionRelay,
        store: Store,
        alive: Callable[[str], bool],
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """An operator is taken to be there at the start: pages have to find the server again.

        Args:
            settings: what robots do.
            name: of the server, which gives the orders.
            relay: hands the orders on, and says when a person has given a mission.
            store: by which servers that share it tell each other of their operators.
            alive: whether a robot is there.
            monotonic: a clock that only grows, s.
        """
        self._settings, self._name, self._relay, self._store = settings, name, relay, store
        self._alive, self._monotonic = alive, monotonic
        self._seen = monotonic()
        self._here = self._said = -math.inf
        relay.given = self.attend

    def attend(self) -> None:
        """An operator is there, at this server."""
        self._here = self._seen = self._monotonic()

    def follow(self) -> None:
        """An operator is there, at another server that shares the store."""
        self._seen = self._monotonic()

    def check(self) -> None:
        """End missions of people if no operator is there; waits for the robots' answers."""
        if self._settings.unattended is Unattended.GO_ON and not self._store.shared:
            return
        now = self._monotonic()
        if self._store.shared and now - self._said >= SAID_EVERY and self._here > self._said:
            self._said = now
            try:
                self._store.put_result(ATTENDED, self._name.encode())
            except MapweaveError as error:
                if not logged(error):
                    log.warning("other servers do not hear that an operator is here: %s", error)
        if self._settings.unattended is Unattended.GO_ON or now - self._seen <= self._settings.grace:
            return
        # Servers that share a store would all say the same.
        if self._store.shared and not self._store.leads:
            return
        in_parallel(self._unattended(), self._end)

    def _unattended(self) -> list[MissionReport]:
        """The mission of each robot that is to be ended."""
        newest: dict[str, MissionReport] = {}
        for report in self._relay.missions().reports:
            if report.open:
                newest[report.order.robot] = report
        return [
            report
            for robot, report in newest.items()
            if report.order.kind in ENDED
            and report.order.by not in (AT_START, self._name)
            # One that is away gets no order that waits for it: it is asked for again once it is back.
            and self._alive(robot)
        ]

    def _end(self, report: MissionReport) -> None:
        robot, because = report.order.robot, f"no operator was there for {self._settings.grace:g} s"
        home = self._settings.unattended is Unattended.HOME
        for kind in (MissionKind.GO, MissionKind.STOP) if home else (MissionKind.STOP,):
            goal = "home" if kind is MissionKind.GO else ""
            try:
                said = self._relay.hand_on(
                    self._relay.request(robot, kind, goal, self._name, because=because)
                )
            except MapweaveError as error:
                # Such as a robot whose map is not merged yet, which has no home.
                log.warning("%s cannot be sent home: %s", robot, error)
                continue
            log.info("%s: %s, since %s: %s", robot, said.order.words, because, said.state)
            if said.open or said.order.kind is MissionKind.STOP:
                return
