"""How long a lost robot goes without an answer when one of two servers is killed."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from itertools import pairwise

from benchmarks.chaos.agent_process import FLEET
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission import WhereAmI
from mapweave.agent.mission_control import MissionControl
from mapweave.hybridmap.node import MapId
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode_view
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus

NAME = "lost"
PAUSE = 0.05
"""Between an answer and the next question, s."""


class LostRobot:
    """A robot's link that asks where it is, again and again. A context manager."""

    def __init__(self, endpoints: Sequence[str], views: Sequence[View]) -> None:
        """Connect; `views` are what it sees, in turn."""
        self._bus = ZenohBus(BusSettings(endpoints=tuple(endpoints)))
        self._client = FleetClient(self._bus, Keys(FLEET), MapId(NAME, 1), MissionControl(NAME))
        self._views, self._stop = views, threading.Event()
        self._thread = threading.Thread(target=self._run, name="lost robot")
        self.found: list[float] = []

    def __enter__(self) -> LostRobot:
        """Begin to ask."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Ask no more."""
        self._stop.set()
        self._thread.join()
        self._client.close()
        self._bus.close()

    def answered_by(self, server: str) -> bool:
        """Whether this server finds the place of every view."""
        key = sent_by(Keys(FLEET).relocalize(server), NAME)
        replies = [self._bus.ask(key, encode_view(view), 3.0) for view in self._views]
        return all(
            any(
                not one.error and decode(one.payload, RelocalizeAnswer).certainty is Certainty.FOUND
                for one in reply
            )
            for reply in replies
        )

    def longest_gap(self, begin: float, end: float) -> float:
        """Longest time without a place between two times, s; what came before begin counts from there."""
        times = [begin, *(t for t in self.found if begin < t < end), end]
        return max(b - a for a, b in pairwise(times))

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(PAUSE):
            self._client.ask(WhereAmI(number, self._views[number % len(self._views)]))
            number += 1
            for answer in self._client.answers(wait=True):
                content = answer.content
                if isinstance(content, RelocalizeAnswer) and content.certainty is Certainty.FOUND:
                    self.found.append(time.monotonic())
