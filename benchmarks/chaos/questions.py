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
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode_view
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus

NAME = "lost"
PAUSE = 0.15
"""Between an answer and the next question, s. A server answers a robot ten times a second in the long run."""


class LostRobot:
    """A robot's link that asks where it is, again and again. A context manager."""

    def __init__(self, endpoints: Sequence[str], views: Sequence[View]) -> None:
        """Connect.

        Args:
            endpoints: of the routers.
            views: what it may see.
        """
        self._bus = ZenohBus(BusSettings(endpoints=tuple(endpoints)))
        self._client = FleetClient(self._bus, Keys(FLEET), MapId(NAME, 1), MissionControl(NAME))
        self._views, self._stop = list(views), threading.Event()
        self._thread = threading.Thread(target=self._run, name="lost robot")
        self.found: list[float] = []

    def __enter__(self) -> LostRobot:
        """Connected; see `start`."""
        return self

    def __exit__(self, *_: object) -> None:
        """Ask no more."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._client.close()
        self._bus.close()

    def recognised(self, servers: Sequence[str]) -> bool:
        """Whether all servers find the place of a view; from then on it is the only one.

        One view in five shows too little to be sure of.
        """
        for view in self._views:
            if all(self._found(view, server) for server in servers):
                self._views = [view]
                return True
        return False

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def longest_gap(self, begin: float, end: float) -> float:
        """Longest time without a place between two times, s; what came before begin counts from there."""
        times = [begin, *(t for t in self.found if begin < t < end), end]
        return max(b - a for a, b in pairwise(times))

    def _found(self, view: View, server: str) -> bool:
        key = sent_by(Keys(FLEET).relocalize(server), NAME)
        replies = [one for one in self._bus.ask(key, encode_view(view), 3.0) if not one.error]
        return any(decode(one.payload, RelocalizeAnswer).certainty is Certainty.FOUND for one in replies)

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(PAUSE):
            self._client.ask(WhereAmI(number, self._views[0]))
            number += 1
            for answer in self._client.answers(wait=True):
                content = answer.content
                if isinstance(content, RelocalizeAnswer) and content.certainty is Certainty.FOUND:
                    self.found.append(time.monotonic())
