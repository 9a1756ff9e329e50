"""Maps that a robot has left leave its disk once its server has pruned all of their nodes.

Such a map stays whole until then. Where newer nodes have superseded a part of it, that part is what ties the
rest to other maps: a server that has lost its store could not place the rest without it
(docs/decisions/pruning.md has the figures).
"""

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.errors import InvalidMessage, MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import MAX_KEPT_NODES, KeptNodes, NewestMap

log = logging.getLogger(__name__)

EVERY = 3600.0
"""Between two questions about the same map, s; a server prunes once a day."""
RETRY = 60.0
"""The same if the server did not answer, s."""
TIMEOUT = 3.0
"""How long a question may take, s."""


class LeftMaps:
    """Asks one server about them, when it appears and then every hour, in a thread of its own."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        journal: Journal,
        replicator: Replicator,
        server: str,
        now_ns: Callable[[], int] = lambda: 0,
        every: float = EVERY,
    ) -> None:
        """Begin to wait for the server.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            journal: of the robot; stays the caller's, and is closed after this.
            replicator: of the journal, likewise. The map that it makes is not left.
            server: which is asked: one that must have a change before it counts as acknowledged.
            now_ns: the clock by which changes are stamped.
            every: s between two questions.
        """
        self._bus, self._journal, self._replicator = bus, journal, replicator
        self._server, self._key = server, keys.ack(server, journal.agent)
        self._now_ns, self._every = now_ns, every
        self._closed = False
        self._work: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=f"left-maps-{journal.agent}", daemon=True)
        self._thread.start()
        self._watching = bus.watch(keys.server_alive(server), lambda _, alive: self._work.put(alive))

    def close(self) -> None:
        """Stop asking."""
        self._watching.close()
        self._closed = True
        self._work.put(False)
        self._thread.join(TIMEOUT + 1.0)

    def look(self) -> bool:
        """Ask about each map that the server has; have those retired of which it has pruned every node.

        Returns:
            Whether it has answered each time.
        """
        answered = True
        for map_id in self._journal.maps():
            if map_id == self._replicator.map_id or self._closed:
                continue
            try:
                there = self._journal.acknowledged(map_id).get(self._server, 0)
                nodes = self._journal.nodes(map_id) if there == self._journal.head(map_id) else []
                pruned = self._all_pruned(nodes) if nodes else False
                answered &= pruned is not None
                if pruned:
                    stamp_ns = max(self._now_ns(), self._journal.newest_stamp(map_id))
                    self._replicator.retire(map_id, nodes, stamp_ns)
                    log.info("%s has pruned all of map %s: it is dropped", self._key, map_id)
            except MapweaveError as error:
                # It stays, and is asked about again.
                log.info("map %s is kept: %s", map_id, error)
        return answered

    def _run(self) -> None:
        there, pause = False, self._every
        while not self._closed:
            with suppress(queue.Empty):
                there = self._work.get(timeout=pause)
            if there and not self._closed:
                pause = self._every if self.look() else min(self._every, RETRY)

    def _all_pruned(self, nodes: Sequence[NodeId]) -> bool | None:
        """Whether the server answers that each of them was pruned; None if it does not answer."""
        for first in range(0, len(nodes), MAX_KEPT_NODES):
            some = nodes[first : first + MAX_KEPT_NODES]
            asked = KeptNodes(some[0].epoch, tuple(node.number for node in some))
            replies = self._bus.ask(self._key, asked.encode(), TIMEOUT)
            if not replies:
                return None
            if not any(self._says_so(reply.payload) for reply in replies if not reply.error):
                return False
        return True

    def _says_so(self, answer: bytes) -> bool:
        try:
            return NewestMap.decode(answer).pruned
        except InvalidMessage as error:
            log.warning("%s", error)
            return False
