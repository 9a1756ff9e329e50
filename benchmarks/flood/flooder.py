"""A robot that sends and asks as much as it can, in a process of its own."""

from __future__ import annotations

import itertools
import threading
import time
from dataclasses import replace

import numpy as np

from benchmarks.flood.fleet import FLEET, FloodRoom
from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.query import KnownRequest, RouteRequest
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Head, LogAnswer, LogRequest, Mark
from mapweave.wire.messages import encode, encode_view
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus

KINDS = ("changes", "beacons", "questions")
EPOCH_CHANGES = 200
"""After so many changes it begins another map."""
TIMEOUT = 5.0
"""s that it waits for an answer."""


class Flooder:
    """A robot that floods the server. Its logs are real: what it publishes it also answers for."""

    def __init__(self, name: str, endpoint: str, rate: float, seed: int) -> None:
        """Connect.

        Args:
            name: of the robot.
            endpoint: of the router.
            rate: changes or beacons a second.
            seed: of its room.
        """
        self._name, self._keys, self._rate = name, Keys(FLEET), rate
        self._bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        self._room = FloodRoom(self._name, 50.0, seed)
        self._logs: dict[int, dict[int, bytes]] = {}
        self._bus.serve(self._keys.logs(self._name), self._answer)

    def run(self, kind: str) -> None:
        """Until the process is ended."""
        self._bus.wait_connected(20.0)
        works = {
            "changes": (self._publish,), "beacons": (self._beacon,),
            "questions": (self._ask, self._ask, self._ask, self._ask_known),
        }  # fmt: skip
        threads = [threading.Thread(target=work, daemon=True) for work in works[kind]]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _publish(self) -> None:
        puts = self._room.nodes
        for number in itertools.count():
            epoch, sequence = 1 + number // EPOCH_CHANGES, 1 + number % EPOCH_CHANGES
            map_id = MapId(self._name, epoch)
            node = replace(puts[number % len(puts)], id=NodeId(*map_id, sequence))
            message = encode_change(Change(map_id, sequence, sequence, NodePut(node)))
            self._logs.setdefault(epoch, {})[sequence] = message
            self._bus.publish(self._keys.change(map_id), message, Mark(sequence, epoch).encode())
            if sequence % 50 == 0:
                self._bus.publish(self._keys.head(map_id), Head(epoch, sequence).encode())
            time.sleep(1.0 / self._rate)

    def _beacon(self) -> None:
        for number in itertools.count(1):
            self._bus.publish(self._keys.head(MapId(self._name, number)), Head(number, 2**40).encode())
            time.sleep(1.0 / self._rate)

    def _ask(self) -> None:
        rng = np.random.default_rng()
        views = [encode_view(self._room.view(rng)[0]) for _ in range(20)]
        a, b = (node.id for node in self._room.nodes[:2])
        route = encode(RouteRequest(a, b))
        for view in itertools.cycle(views):
            for what, payload in ((self._keys.any_relocalize(), view), (self._keys.any_route(), route)):
                self._bus.ask(sent_by(what, self._name), payload, TIMEOUT)

    def _ask_known(self) -> None:
        payload = encode(KnownRequest(MapId(self._name, 1), 0.0, 0.0, 20.0))
        while True:
            self._bus.ask(sent_by(self._keys.any_known(), self._name), payload, TIMEOUT)

    def _answer(self, request: Request) -> None:
        epoch = self._keys.parse_log(request.key).epoch
        rows = self._logs.get(epoch)
        if rows is None:
            return  # it never answers
        asked = LogRequest.decode(request.payload)
        found = tuple((s, rows[s]) for s in range(asked.first, asked.last + 1) if s in rows)
        request.reply(LogAnswer(epoch, asked.first, min(asked.last, max(rows)), found).encode())


def flood(endpoint: str, kind: str, rate: float, seed: int) -> None:
    """Flood a server until this process is ended."""
    Flooder(f"flood-{kind}", endpoint, rate, seed).run(kind)
