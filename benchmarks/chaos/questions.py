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

NAME, LOOKER = "lost", "looks"
"""Of the robot, and of who looks whether the servers know the place: a server takes one question of a robot
at a time, and the robot's next one is under way all the time."""
TIMEOUT = 3.0
"""Of a look, s."""
PAUSE = 0.15
"""Between an answer and the next question, s. A server answers a robot ten times a second in the long run."""


class LostRobot:
    """A robot's link that asks where it is, again and again. A context manager.

    Attributes:
        found: when an answer had a place, s of the system's monotonic clock.
        missing: what servers answered instead when it was looked last whether all recognise a place.
    """

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
        self.missing: list[str] = []

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
            said = {server: self._asked(view, server) for server in servers}
            self.missing = [f"{server}: {words}" for server, words in said.items() if words]
            if not self.missing:
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

    def _asked(self, view: View, server: str) -> str:
        """Ask one server; why the place is not found, or nothing."""
        key = sent_by(Keys(FLEET).relocalize(server), LOOKER)
        replies = self._bus.ask(key, encode_view(view), TIMEOUT)
        answers = [decode(one.payload, RelocalizeAnswer) for one in replies if not one.error]
        if any(one.certainty is Certainty.FOUND for one in answers):
            return ""
        refused = [f"refused, {one.error}" for one in replies if one.error]
        return "; ".join([f"{one.certainty}, {one.reason}" for one in answers] + refused) or "no answer"

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(PAUSE):
            self._client.ask(WhereAmI(number, self._views[0]))
            number += 1
            for answer in self._client.answers(wait=True):
                content = answer.content
                if isinstance(content, RelocalizeAnswer) and content.certainty is Certainty.FOUND:
                    self.found.append(time.monotonic())
