"""Which robots time waits for: a pure object without threads and clocks.

A robot is *active* from its first step on, until its agent is gone or it keeps the others waiting for too
long. A tick is due when every active robot has asked for one.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

from mapweave.agent.drivers.messages import AGAIN, StepRequest
from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.lockstep_robot import Rendezvous
from mapweave.wire.bus import Request

log = logging.getLogger(__name__)

SOON = 3.0
"""After this time it is logged for which robots the beginning waits, s."""


@dataclass(slots=True, eq=False)
class Seat:
    """One robot's place in the lock-step.

    Attributes:
        name: the robot's.
        active: whether time waits for it.
        asked: whether it has ever asked.
        step: what it asked last and has not been answered yet.
        request: where that answer goes.
        since: when it asked that for the first time, s.
        sequence: number of the last step that was answered; 0 before.
        answer: to that step.
        answered_at: when, s.
        drivers: numbers of those that are alive.
    """

    name: str
    active: bool = False
    asked: bool = False
    step: StepRequest | Rendezvous | None = None
    request: Request | None = None
    since: float = 0.0
    sequence: int = 0
    answer: bytes = b""
    answered_at: float = 0.0
    drivers: set[int] = field(default_factory=set)


class StepBarrier:
    """Collects the robots' steps and says when a tick is due. Times are of any clock that only grows, s."""

    def __init__(self, robots: Sequence[str], patience: float) -> None:
        """Start before the first question.

        Args:
            robots: names.
            patience: how long the others wait for a robot that does not ask, s.
        """
        # Sorted: nothing may depend on the order in which robots ask.
        self._seats = {name: Seat(name) for name in sorted(robots)}
        self._patience = patience
        self._begun = self._reported = False

    @property
    def active(self) -> set[str]:
        """Names of the robots that time waits for."""
        return {seat.name for seat in self._seats.values() if seat.active}

    def receive(self, name: str, step: StepRequest | Rendezvous, request: Request, now: float) -> None:
        """Take a robot's step; one that was answered before is answered at once with the same."""
        seat = self._seats[name]
        newest = seat.step.sequence if seat.step is not None else seat.sequence
        if step.sequence == seat.sequence and seat.step is None:
            request.reply(seat.answer)
            seat.answered_at = now
        elif step.sequence < newest and step.sequence != 1:
            request.refuse(f"step {step.sequence} is over, the last was {newest}")
            return
        else:
            if seat.request is not None:
                seat.request.refuse(f"asked twice, {AGAIN}")
            if seat.step is None:
                seat.since = now
            seat.step, seat.request = step, request
        seat.active = seat.asked = True

    def presence(self, name: str, driver: int, alive: bool) -> None:
        """Note that a driver came or went; time does not wait for a robot without a driver."""
        seat = self._seats.get(name)
        if seat is None:
            return
        (seat.drivers.add if alive else seat.drivers.discard)(driver)
        if alive or seat.drivers or not seat.active:
            return
        log.info("the agent of robot %s is gone: the robot stands still until it asks again", name)
        seat.active = False
        if seat.request is not None:
            # Should a successor have asked already, it asks again.
            seat.request.refuse(f"the agent is gone, {AGAIN}")
            seat.step = seat.request = None

    def due(self, now: float) -> list[Seat]:
        """The robots that have asked, by name, if a tick is due; else none."""
        waiting = [seat for seat in self._seats.values() if seat.step is not None]
        if not waiting:
            return []
        since = min(seat.since for seat in waiting)
        if not self._begun:
            self._begun = self._may_begin(now - since)
            if not self._begun:
                return []
        complete = True
        for seat in self._seats.values():
            if seat.active and seat.step is None:
                if now - max(since, seat.answered_at) >= self._patience:
                    seat.active = False
                    log.warning(
                        "robot %s has not asked for %g s: it stands still until it asks again",
                        seat.name,
                        self._patience,
                    )
                else:
                    complete = False
        return waiting if complete else []

    def answer(self, seat: Seat, payload: bytes, now: float) -> None:
        """Answer what a robot asked."""
        if seat.step is None or seat.request is None:
            raise InvalidValue(f"robot {seat.name} has not asked")
        seat.sequence, seat.answer, seat.answered_at = seat.step.sequence, payload, now
        request, seat.step, seat.request = seat.request, None, None
        request.reply(payload)

    def refuse_all(self, reason: str) -> set[str]:
        """Refuse what was asked; returns whose."""
        refused = set()
        for seat in self._seats.values():
            if seat.request is not None:
                seat.request.refuse(reason)
                seat.step = seat.request = None
                refused.add(seat.name)
        return refused

    def _may_begin(self, waited: float) -> bool:
        missing = [seat.name for seat in self._seats.values() if not seat.asked]
        if not missing:
            return True
        if waited < self._patience:
            if waited >= SOON and not self._reported:
                self._reported = True
                names = ", ".join(missing)
                log.info("time waits for the agents of %s, %g s at the longest", names, self._patience)
            return False
        for name in missing:
            log.warning("robot %s has not asked for %g s: time begins without it", name, self._patience)
        return True
