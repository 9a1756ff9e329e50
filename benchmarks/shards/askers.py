"""Lost robots that ask without a pause, and what they were answered."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from benchmarks.shards.fleet import FLEET, BuildingFleet
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer
from mapweave.wire.bus import Reply
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode
from mapweave.wire.zenoh_bus import ZenohBus

ASK_WITHIN = 5.0
"""Longest wait for one answer, s; then the question is asked again."""
IN_A_ROW = 10
"""Whole answers in a row after which a server counts as recovered."""
PATIENCE = 120.0
"""Longest wait for a server to read, merge, or be whole again, s."""


@dataclass
class AnswerLog:
    """What robots were answered: when, and whether the whole map was searched.

    Attributes:
        answers: time of each answer, s, and whether it was whole.
        seconds: that each answer took.
        asked_again: questions that were refused or lost, and asked again.
        found: answers that were certain.
        wrong: of these, those somewhere else.
        unanswered: questions without an answer at the end.
    """

    answers: list[tuple[float, bool]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    asked_again: int = 0
    found: int = 0
    wrong: int = 0
    unanswered: int = 0

    def whole(self, since: float) -> bool:
        """Whether answers have come since then, and the last ones are whole."""
        last = [(at, whole) for at, whole in self.answers[-IN_A_ROW:] if at > since]
        return len(last) == IN_A_ROW and all(whole for _, whole in last)

    def recovery(self, since: float) -> float:
        """The longest time without a whole answer since then, s."""
        whole = [since, *sorted(at for at, whole in list(self.answers) if whole and at > since)]
        return float(np.diff(whole).max())


class Askers:
    """Lost robots that ask without a pause until they are stopped."""

    def __init__(self, fleet: BuildingFleet, endpoint: str, count: int) -> None:
        """Connect."""
        self._fleet, self._questions = fleet, fleet.questions(200)
        self._buses = [ZenohBus(BusSettings(endpoints=(endpoint,))) for _ in range(count)]
        self._stop = threading.Event()
        self.tally = AnswerLog()
        self._pool = ThreadPoolExecutor(count)
        self._asking = [self._pool.submit(self._ask, bus, k) for k, bus in enumerate(self._buses)]

    def close(self) -> AnswerLog:
        """Let each get its last answer, and disconnect."""
        self._stop.set()
        for asking in self._asking:
            asking.result()
        self._pool.shutdown()
        for bus in self._buses:
            bus.close()
        return self.tally

    def _ask(self, bus: ZenohBus, number: int) -> None:
        key, tally = Keys(FLEET).any_relocalize(), self.tally
        bus.wait_connected(PATIENCE)
        while not self._stop.is_set():
            message, pose = self._questions[number % len(self._questions)]
            number += len(self._buses)
            began, end = time.monotonic(), time.monotonic() + PATIENCE
            while True:
                asked = time.monotonic()
                replies = bus.ask(key, message, ASK_WITHIN, enough=_answers)
                answers = [reply for reply in replies if _answers(reply)]
                if answers:
                    break
                tally.asked_again += 1
                if time.monotonic() > end:
                    tally.unanswered += 1
                    return
                pause = replies[0].retry_after if replies else 0.0
                time.sleep(max(pause or 0.0, asked + 0.1 - time.monotonic()))
            answer = decode(answers[0].payload, RelocalizeAnswer)
            tally.seconds.append(time.monotonic() - began)
            tally.answers.append((time.monotonic(), not answer.partial))
            if answer.certainty is Certainty.FOUND:
                tally.found += 1
                tally.wrong += self._fleet.is_wrong(answer, pose)


def _answers(reply: Reply) -> bool:
    """Whether it is an answer: the first one counts."""
    return not reply.error
