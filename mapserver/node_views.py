"""Images of nodes, from the robots that keep them. A server keeps none but the last ones, in memory."""

import threading
from collections import OrderedDict
from collections.abc import Callable

from mapweave.hybridmap.errors import Busy, InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.view_image import ViewImage, ViewRequest
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.view_file import checked_view
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode

PATIENCE = 1.0
"""How long a robot may take to answer, s."""
MOST_CACHED = 256
"""Images in memory, 16 MiB at most."""
MOST_ASKED = 8
"""Questions to robots at once: one that hangs must not hold up all that people ask of the server."""


class NoView(MapweaveError):
    """There is no image of a node, or none can be had at present."""


class NodeViews:
    """Asks robots; any thread may ask it."""

    def __init__(self, bus: Bus, keys: Keys, merged: Callable[[], MergedMap]) -> None:
        """Begin to watch which robots keep images."""
        self._bus, self._keys, self._merged = bus, keys, merged
        self._agents: set[str] = set()
        self._cache: OrderedDict[NodeId, bytes] = OrderedDict()
        self._turn = threading.Lock()
        self._asking = threading.BoundedSemaphore(MOST_ASKED)
        self._watching = bus.watch(keys.views(), self._see)

    def close(self) -> None:
        """Stop watching."""
        self._watching.close()

    def why_none(self, node: NodeId) -> str:
        """Why asking for the image of a node is of no use; empty if its robot is there and keeps images."""
        if node.agent in self._agents or node in self._cache:
            return ""
        return f"{node.agent} is away, or keeps no views (keep_views in [agent] of its settings)"

    def view(self, node: NodeId) -> bytes:
        """The image of a node, a JPEG file; waits for the robot.

        Raises:
            InvalidValue: there is no such node.
            NoView: the robot is away, has kept none, or does not answer with one.
            Busy: too many wait for robots, or the robot's disk is busy.
        """
        merged = self._merged()
        merged.check(node)
        with self._turn:
            if node in self._cache:
                self._cache.move_to_end(node)
                return self._cache[node]
        if missing := self.why_none(node):
            raise NoView(missing)
        camera = merged.maps[node.map].nodes[node].camera
        if not self._asking.acquire(blocking=False):
            raise Busy(PATIENCE)
        try:
            jpeg = checked_view(self._asked(node), camera)
        except (InvalidMessage, InvalidValue) as error:
            raise NoView(f"what {node.agent} gave as its view of {node} is refused: {error}") from None
        finally:
            self._asking.release()
        with self._turn:
            self._cache[node] = jpeg
            while len(self._cache) > MOST_CACHED:
                self._cache.popitem(last=False)
        return jpeg

    def _asked(self, node: NodeId) -> bytes:
        """What its robot gives."""
        key, question = self._keys.view(node.agent), encode(ViewRequest(node))
        reason, retry_after = f"{node.agent} does not answer", 0.0
        for reply in self._bus.ask(key, question, PATIENCE, lambda reply: not reply.error):
            if reply.error:
                reason, retry_after = reply.error.removeprefix("refused: "), reply.retry_after
                continue
            answer = decode(reply.payload, ViewImage)
            if answer.node != node:
                raise InvalidMessage(f"it is of {answer.node}")
            return answer.jpeg
        if retry_after > 0.0:
            raise Busy(retry_after)
        raise NoView(reason)

    def _see(self, key: str, alive: bool) -> None:
        try:
            agent = self._keys.parse_view(key)
        except InvalidMessage:
            return
        if alive:
            self._agents.add(agent)
        else:
            self._agents.discard(agent)
