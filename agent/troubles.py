"""Why a robot's questions to the fleet have no answer at present: when each such trouble begins and ends."""

from __future__ import annotations

import logging
import threading
import time
from typing import NamedTuple

from mapweave.agent.mission import Question
from mapweave.hybridmap.agent_status import one_line

log = logging.getLogger(__name__)


class Trouble(NamedTuple):
    """A kind of question that has no answer.

    Attributes:
        words: the newest reason.
        since: when it began, on the monotonic clock, s.
        unheard: whether no server has answered at all; else one has refused.
    """

    words: str
    since: float
    unheard: bool


class Troubles:
    """What holds at present, by kind of question; beginnings and ends are logged. Thread-safe.

    A trouble ends with the next answer to a question of its kind. That no server answers also ends with any
    answer, and when a server comes. All end with the mission in which the robot asked.
    """

    def __init__(self) -> None:
        """Begin without any."""
        self._turn = threading.Lock()
        self._holding: dict[type[Question], Trouble] = {}
        self._mission: object = None

    def begin(self, question: type[Question], words: str, unheard: bool) -> None:
        """A question has no answer.

        Args:
            question: its kind.
            words: why.
            unheard: whether no server has answered at all.
        """
        words, now = one_line(words), time.monotonic()
        with self._turn:
            before = self._holding.pop(question, None)
            self._holding[question] = Trouble(words, now if before is None else before.since, unheard)
        if before is None or before.unheard is not unheard:
            log.warning("a question to the fleet has no answer: %s", words)

    def answered(self, question: type[Question]) -> None:
        """A question of this kind has an answer."""
        self._end([kind for kind, one in self._holding.copy().items() if kind is question or one.unheard])

    def server_is_there(self) -> None:
        """A server has come."""
        self._end([kind for kind, one in self._holding.copy().items() if one.unheard])

    def mission(self, holding: object) -> None:
        """Another mission holds than before, or its state is another one: what was asked for it is over.

        Args:
            holding: compares equal while nothing changes.
        """
        if holding != self._mission:
            self._mission = holding
            self._end([*self._holding.copy()])

    def newest(self) -> tuple[str, float]:
        """What holds, in words, and for how long, s; empty and 0 without any. Of several the newest."""
        with self._turn:
            if not self._holding:
                return "", 0.0
            trouble = [*self._holding.values()][-1]
        return trouble.words, time.monotonic() - trouble.since

    def _end(self, kinds: list[type[Question]]) -> None:
        now = time.monotonic()
        with self._turn:
            over = [one for kind in kinds if (one := self._holding.pop(kind, None)) is not None]
        for one in over:
            log.info("over after %.0f s: %s", now - one.since, one.words)
