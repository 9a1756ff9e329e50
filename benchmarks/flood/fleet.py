"""Honest robots: each maps a room, sends its changes with the real replicator, and asks where it is."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import encode_view
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import changes_of
from synthetic.world import room, take_map, take_view

FLEET = "flood"
NODES = 20
"""Of a room."""
PATIENCE = 60.0
"""Longest wait for an acknowledgement or an answer, s."""
PERIOD = 1.0
"""s between two changes of a robot, and between two questions: one of the demo sends 0.7 changes a second,
and one that is lost asks as often."""


class FloodRoom:
    """A room of which a robot has a map.

    Attributes:
        nodes: of the map.
        changes: that make the map.
    """

    def __init__(self, robot: str, x: float, seed: int) -> None:
        """Map a room.

        Args:
            robot: whose map it is.
            x: of the room's corner, m.
            seed: of its looks.
        """
        rng = np.random.default_rng(seed)
        self._world = room(x, 0, 5, 4, 700, rng)
        self._stops = [
            Pose2(x + rng.uniform(1.2, 3.8), rng.uniform(1.2, 2.8), rng.uniform(-math.pi, math.pi))
            for _ in range(NODES)
        ]
        self.nodes, edges = take_map(self._world, MapId(robot, 1), self._stops, rng)
        self.changes = changes_of(self.nodes, edges)

    def view(self, rng: np.random.Generator) -> tuple[View, NodeId]:
        """A view a little beside a node."""
        k = int(rng.integers(len(self._stops)))
        pose = self._stops[k] @ Pose2.from_vector(rng.normal(0, [0.12, 0.12, 0.1]))
        return take_view(self._world, pose, rng)[0], self.nodes[k].id


@dataclass
class Waits:
    """How long robots waited, s, and how often without an answer."""

    acks: list[float] = field(default_factory=list)
    answers: list[float] = field(default_factory=list)
    lost: int = 0


class HonestRobot:
    """Sends one change a second, and asks once a second."""

    def __init__(self, number: int, endpoint: str, folder: Path, seed: int) -> None:
        """Connect."""
        self.name = f"r{number}"
        self._bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        self._room = FloodRoom(self.name, 20.0 * number - 200.0, seed + number)
        self._journal = Journal(folder / f"{self.name}.sqlite", self.name)
        self._map = self._journal.open_map(1)
        self._replicator = Replicator(self._bus, Keys(FLEET), self._journal, self._map, ["s0"])
        self._rng = np.random.default_rng(seed + 100 + number)
        self._put = 0

    def hand_over(self) -> bool:
        """Send the map; whether the server has it."""
        self._replicator.submit(self._room.changes, 1)
        return self._replicator.wait_acknowledged(PATIENCE)

    def work(self, seconds: float, waits: Waits) -> None:
        """Send and ask for so long."""
        end = time.monotonic() + seconds
        threads = [threading.Thread(target=work, args=(end, waits)) for work in (self._send, self._ask)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def close(self) -> None:
        """Disconnect."""
        self._replicator.close()
        self._bus.close()
        self._journal.close()

    def _send(self, end: float, waits: Waits) -> None:
        while (began := time.monotonic()) < end:
            old = self._room.nodes[self._put % NODES]
            self._put += 1
            self._replicator.submit([NodePut(replace(old, stamp_ns=old.stamp_ns + self._put))], self._put)
            if self._replicator.wait_acknowledged(PATIENCE):
                waits.acks.append(time.monotonic() - began)
            else:
                waits.lost += 1
            time.sleep(max(began + PERIOD - time.monotonic(), 0.0))

    def _ask(self, end: float, waits: Waits) -> None:
        keys = Keys(FLEET)
        key = sent_by(keys.any_relocalize(), self.name)
        while (began := time.monotonic()) < end:
            message = encode_view(self._room.view(self._rng)[0])
            began = time.monotonic()
            while True:
                replies = self._bus.ask(key, message, PATIENCE)
                if not replies or not replies[0].retry_after:
                    break
                time.sleep(replies[0].retry_after)
            if replies and not replies[0].error:
                waits.answers.append(time.monotonic() - began)
            else:
                waits.lost += 1
            time.sleep(max(began + PERIOD - time.monotonic(), 0.0))
