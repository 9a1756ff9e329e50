"""Keeps a small image of each node on the robot's disk, and gives it to map servers that ask for it.

One thread does all work with the disk. The robot's loop hands images over and never waits: an image for which
the disk has no time is left out. A missing or damaged file means that the node has no image, nothing more.
"""

import logging
import queue
import threading
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from mapweave.agent.mapping.view import RawImage
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.errors import Busy, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.view_image import ViewImage, ViewRequest
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.view_file import is_whole, view_file
from mapweave.wire.bus import Bus, BusClient, Request
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode

log = logging.getLogger(__name__)

MOST_VIEWS = 10_000
"""Images on the disk, some 200 MB; the oldest make room."""
MOST_WAITING = 8
"""Tasks that wait for the disk: a further image is left out, a further question refused."""
RETRY_AFTER = 1.0
"""s."""
SUFFIX = ".jpg"


class ViewKeeper(BusClient):
    """Keeps the images of one robot's nodes, for all its maps."""

    def __init__(self, bus: Bus, keys: Keys, agent: str, folder: Path) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            agent: name of the robot.
            folder: of the images; made when the first one comes.
        """
        self._agent, self._folder = agent, folder
        self._kept: dict[NodeId, Path] = {}
        self._failed = False
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._tasks.put(self._look)
        self._thread = threading.Thread(target=self._work, name="views", daemon=True)
        self._thread.start()
        key = keys.view(agent)
        self._closing = [bus.serve(key, self._asked), bus.announce(key)]

    def keep(self, images: Iterable[tuple[NodeId, RawImage]], changes: Iterable[ChangeBody]) -> None:
        """Keep images of new nodes, and remove those of retired nodes; never waits."""
        for node, image in images:
            if self._tasks.qsize() < MOST_WAITING:
                self._tasks.put(partial(self._write, node, image))
        for change in changes:
            if isinstance(change, NodeRetired):
                self._tasks.put(partial(self._remove, change.id))

    def keep_only(self, map_id: MapId, nodes: Iterable[NodeId]) -> None:
        """Remove the images of all other nodes of a map that goes on; never waits."""
        self._tasks.put(partial(self._remove_others, map_id, frozenset(nodes)))

    def close(self) -> None:
        """Write what waits, and stop answering. The bus stays open."""
        super().close()
        self._tasks.put(None)
        self._thread.join(5.0)

    def _asked(self, request: Request) -> None:
        node = decode(request.payload, ViewRequest).node
        if self._tasks.qsize() >= MOST_WAITING:
            raise Busy(RETRY_AFTER)
        self._tasks.put(partial(self._answer, request, node))

    # In the thread

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None:
            try:
                task()
            except Exception as error:  # noqa: BLE001 - a thread that ends without a word answers no one again
                # A disk that stays full is reported once.
                if not self._failed:
                    words = " ".join(str(error).split()) or type(error).__name__
                    log.warning("an image of a node is not kept: %s", words)
                self._failed = True

    def _look(self) -> None:
        """Find what was kept before, the oldest first."""
        for unfinished in self._folder.glob(".*.part"):
            unfinished.unlink(missing_ok=True)
        for path in self._folder.glob(f"{self._agent}.*{SUFFIX}"):
            try:
                self._kept[NodeId.parse(path.stem)] = path
            except InvalidValue:
                continue
        self._kept = dict(sorted(self._kept.items()))

    def _write(self, node: NodeId, image: RawImage) -> None:
        jpeg = view_file(image.lens.undistorted(image.pixels), image.lens.camera)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{node}{SUFFIX}"
        write_whole(path, jpeg)
        # Not with each task: an answer says nothing of what can be written.
        self._failed = False
        self._kept[node] = path
        while len(self._kept) > MOST_VIEWS:
            self._remove(next(iter(self._kept)))

    def _remove(self, node: NodeId) -> None:
        path = self._kept.pop(node, None)
        if path is not None:
            path.unlink(missing_ok=True)

    def _remove_others(self, map_id: MapId, nodes: frozenset[NodeId]) -> None:
        for node in [node for node in self._kept if node.map == map_id and node not in nodes]:
            self._remove(node)

    def _answer(self, request: Request, node: NodeId) -> None:
        path = self._kept.get(node)
        try:
            jpeg = b"" if path is None else read_whole(path)
        except OSError:
            jpeg = b""
        if is_whole(jpeg):
            request.reply(encode(ViewImage(node, jpeg)))
        else:
            request.refuse(f"{self._agent} has kept no view of {node}")
