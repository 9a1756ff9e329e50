"""The whole merged map as a file: packed once for each merge, in the background of all other questions.

Packing 1000 nodes takes seconds, in which acknowledgements, routes and status messages must go on. A question
that comes while it is packed waits for the one pack after it, so a crowd costs no more than two.
"""

import threading
import weakref
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.map_event import MapEvent
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.map_files import map_file_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.map_file import pack_map_file
from mapweave.wire.bus import Request

MAX_WAITING = 256
"""Questions; more are refused."""
PAUSE = 2.0
"""After what time these may be asked again, s."""


class PackedMap:
    """Answers questions for the map until closed."""

    def __init__(
        self,
        answers: Callable[[], Answers],
        history: Callable[[], Iterable[MapEvent]],
        answer: Callable[[Request, Callable[[], bytes]], None],
        executor: Executor,
        annotations: Callable[[], Annotations] = Annotations,
        images: Callable[[], Mapping[str, bytes]] = dict,
    ) -> None:
        """Start.

        Args:
            answers: the newest ones. May wait for them.
            history: of the map, which the file takes along.
            answer: replies to a question with what a function returns, or refuses with what it raises.
            executor: packs, one job at a time; it is shut down with this.
            annotations: of the map, likewise.
            images: of the plans among them.
        """
        self._images = images
        self._annotations = annotations
        self._answers = answers
        self._history = history
        self._answer = answer
        self._executor = executor
        self._lock = threading.Lock()
        self._waiting: list[Request] = []
        self._working = False
        self._packed: tuple[weakref.ref[MergedMap], tuple[MapEvent, ...], Annotations, bytes] | None = None

    def ask(self, request: Request) -> None:
        """Answer some time later.

        Raises:
            Busy: too many wait.
        """
        with self._lock:
            if len(self._waiting) >= MAX_WAITING:
                raise Busy(PAUSE)
            self._waiting.append(request)
            if self._working:
                return
            self._working = True
        self._executor.submit(self._work)

    def packed(self) -> Future[bytes]:
        """The file of the newest merge, some time later, from any thread."""
        return self._executor.submit(self.pack)

    def close(self) -> None:
        """Answer what has come and stop."""
        self._executor.shutdown()

    def pack(self) -> bytes:
        """The file of the newest merge."""
        merged, history, said = self._answers().merged, tuple(self._history()), self._annotations()
        if self._packed is not None and self._packed[0]() is merged and self._packed[1:3] == (history, said):
            return self._packed[3]
        data = pack_map_file(map_file_of(merged, history, said, self._images()))
        # Bytes of a map that has been replaced are freed with it.
        self._packed = weakref.ref(merged, self._forget), history, said, data
        return data

    def _forget(self, reference: weakref.ref[MergedMap]) -> None:
        packed = self._packed
        if packed is not None and packed[0] is reference:
            self._packed = None

    def _work(self) -> None:
        while True:
            with self._lock:
                requests, self._waiting = self._waiting, []
                if not requests:
                    self._working = False
                    return
            data: list[bytes] = []

            def once(data: list[bytes] = data) -> bytes:
                if not data:
                    data.append(self.pack())
                return data[0]

            for request in requests:
                self._answer(request, once)
