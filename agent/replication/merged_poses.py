"""Poses of an agent's nodes in the merged map, as its server sends them.

They are kept beside the map and change nothing in it. Messages may be lost; each names the message that must
precede it, and where one is missing all poses are asked for.
"""

import logging
import queue
import threading

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.wire.bus import Bus, BusClient, Sample
from mapweave.wire.dispatch import Failures
from mapweave.wire.keys import Keys
from mapweave.wire.pose_messages import MAX_POSTURES, MergedPose, PoseNews

log = logging.getLogger(__name__)


TIMEOUT = 3.0
"""How long a question may take, s."""
MOST_WAITING = 64
"""Messages that wait for the thread: a server sends one after a merge. More of them are dropped."""


class MergedPoses(BusClient):
    """Listens to one server. A thread of its own asks when something is missing."""

    def __init__(self, bus: Bus, keys: Keys, agent: str, server: str) -> None:
        """Begin to listen.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            agent: whose nodes.
            server: whose poses are taken.
        """
        self._bus, self._agent = bus, agent
        self._key = keys.poses(server, agent)
        self._places: dict[NodeId, MergedPose] = {}
        self._run: int | None = None
        self._sequence, self._failures = 0, Failures()
        self._work: queue.SimpleQueue[Sample | bool | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._listen, name=f"poses-{agent}", daemon=True)
        self._thread.start()
        self._closing = [
            bus.subscribe(self._key, self._hear, direct=True),
            bus.watch(keys.server_alive(server), lambda _, alive: self._hear(alive)),
        ]

    def of(self, node: NodeId) -> MergedPose | None:
        """Pose of a node in the merged map; None if it is unknown."""
        return self._places.get(node)

    def count(self, map_id: MapId) -> int:
        """How many nodes of a map are known to lie somewhere."""
        return sum(node.map == map_id for node in tuple(self._places))

    def close(self) -> None:
        """Stop listening."""
        super().close()
        self._work.put(None)
        self._thread.join(TIMEOUT + 1.0)

    def _hear(self, item: Sample | bool) -> None:
        if self._work.qsize() < MOST_WAITING:
            self._work.put(item)

    def _listen(self) -> None:
        while (item := self._work.get()) is not None:
            if isinstance(item, bool):
                if item:
                    self._ask()
                continue
            try:
                self._take(PoseNews.decode(item.payload, self._agent))
            except InvalidMessage as error:
                self._complain(error)
                self._ask()

    def _take(self, news: PoseNews) -> None:
        if news.run != self._run or news.after > self._sequence:
            self._ask()
        elif news.after == self._sequence < news.sequence:
            gone = frozenset(news.gone)
            left = {node: place for node, place in self._places.items() if node not in gone}
            if len(left.keys() | news.placed.keys()) > MAX_POSTURES:
                # As many as one message holds: a server that lies could name nodes without end.
                self._ask()
            else:
                self._places, self._sequence = left | dict(news.placed), news.sequence

    def _ask(self) -> None:
        """Ask for all of it. Without an answer it stays as it is: the next news will show the gap again."""
        for reply in self._bus.ask(self._key, b"", TIMEOUT):
            if reply.error:
                log.info("no merged poses: %s", reply.error)
                continue
            try:
                whole = PoseNews.decode(reply.payload, self._agent)
            except InvalidMessage as error:
                self._complain(error)
                continue
            self._places, self._run, self._sequence = dict(whole.placed), whole.run, whole.sequence

    def _complain(self, error: InvalidMessage) -> None:
        """One line a minute: a server that lies may send something else that is wrong each time."""
        if (also := self._failures.count(self._key)) is not None:
            log.warning("%s%s", error, also)
