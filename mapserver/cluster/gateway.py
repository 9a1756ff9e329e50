"""The way to the cluster: a child process that is Ray's driver, started again whenever it ends.

Ray ends a driver that has lost its cluster, holds threads and signal handlers, and takes seconds to import.
So the server never imports it: requests and answers are bytes that pass through the child.
"""

import logging
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from multiprocessing.connection import Connection
from queue import SimpleQueue
from socket import socketpair
from typing import NamedTuple

from mapweave.hybridmap.errors import InvalidMessage, MapweaveError
from mapweave.mapserver.cluster.frames import MOST_FRAME, GatewayReply, GatewayRequest

log = logging.getLogger(__name__)

WORK = -1
"""Instead of a shard's number: a request that any worker answers, see mapweave.mapserver.cluster.work."""
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 15.0
"""s between two attempts to reach a cluster; it doubles."""
SILENCE = 30.0
"""s without any answer to what was asked, after which the child is started again: Ray notices only after more
than a minute that its head is gone."""
SAID_EVERY = 15.0
"""s; so often a server says that it waits for its cluster."""
PROCESS = "mapweave.mapserver.cluster.gateway_process"


class ClusterGone(MapweaveError):
    """The cluster is not there."""


class _Child(NamedTuple):
    process: subprocess.Popen[bytes]
    connection: Connection
    outbox: SimpleQueue[GatewayRequest | None]


class Gateway:
    """Requests to shards and workers of a cluster. Its methods may be called from any thread.

    Attributes:
        workers: of the cluster; 0 while it is not there.
    """

    def __init__(self, address: str, shards: int) -> None:
        """Prepare; nothing runs yet.

        Args:
            address: of the cluster, or `auto`.
            shards: how many there are to be.
        """
        self._address, self._shards = address, shards
        self._lock = threading.Lock()
        self._child: _Child | None = None
        self._ready = False
        self._next, self._heard = 0, 0.0
        self._pending: dict[int, Future[bytes]] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="cluster", daemon=True)
        self.workers = 0

    def start(self) -> None:
        """Begin to reach the cluster."""
        self._thread.start()

    def close(self) -> None:
        """Leave the cluster: what this has started there ends. Idempotent."""
        self._closing.set()
        with self._lock:
            if self._child is not None:
                self._child.outbox.put(None)
        if self._thread.is_alive():
            self._thread.join(20.0)

    def ask(self, target: int, request: bytes) -> Future[bytes]:
        """Send a request to a shard by its number, or to any worker (`WORK`). Returns at once.

        The future raises ClusterGone if the cluster is not there, or is lost meanwhile, and MapweaveError
        with the reason if the shard or worker fails.
        """
        answer: Future[bytes] = Future()
        with self._lock:
            if self._ready and self._child is not None:
                self._next += 1
                if not self._pending:
                    self._heard = time.monotonic()
                self._pending[self._next] = answer
                self._child.outbox.put(GatewayRequest(self._next, target, request))
                return answer
        answer.set_exception(ClusterGone("the cluster is not there"))
        return answer

    def _keep(self) -> None:
        """Keep the child, in a thread of its own: run the child, and again when it has ended."""
        pause = FIRST_PAUSE
        while not self._closing.is_set():
            began = time.monotonic()
            child = self._start()
            try:
                words = self._serve(child)
            except (EOFError, OSError, InvalidMessage) as error:
                words = str(error) or "its process has ended"
            finally:
                self._end(child)
            if self._closing.is_set():
                return
            if time.monotonic() - began > LONGEST_PAUSE:
                pause = FIRST_PAUSE
            log.warning("the cluster at %s is not there: %s", self._address, words)
            self._closing.wait(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)

    def _start(self) -> _Child:
        ours, theirs = socketpair()
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", PROCESS, str(theirs.fileno()), self._address, str(self._shards)],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )  # fmt: skip
        child = _Child(process, Connection(ours.detach()), SimpleQueue())
        with self._lock:
            self._child = child
            if self._closing.is_set():
                child.outbox.put(None)
        threading.Thread(target=_write, args=(child,), name="cluster requests", daemon=True).start()
        return child

    def _serve(self, child: _Child) -> str:
        """Hand on answers until the child ends: why, in words."""
        connection, began, said = child.connection, time.monotonic(), 0.0
        while not connection.poll(1.0):
            if self._closing.is_set():
                return ""
            if (waited := time.monotonic() - began) > said + SAID_EVERY:
                said = waited
                log.info(
                    "the cluster at %s is not reached yet, after %.0f s: this process works alone meanwhile",
                    self._address, waited,
                )  # fmt: skip
        first = _received(connection)
        if first.words:
            return first.words
        with self._lock:
            self._ready, self.workers = True, first.number
        log.info("in the cluster at %s, with %d workers", self._address, self.workers)
        while True:
            if connection.poll(1.0):
                reply = _received(connection)
                with self._lock:
                    self._heard = time.monotonic()
                    future = self._pending.pop(reply.number, None)
                if future is None:
                    continue
                if reply.words:
                    future.set_exception(MapweaveError(reply.words))
                else:
                    future.set_result(reply.message)
            with self._lock:
                if self._pending and time.monotonic() - self._heard > SILENCE:
                    return f"no answer for {SILENCE:g} s"
            if self._closing.is_set():
                return ""

    def _end(self, child: _Child) -> None:
        """End a child, and what was asked of it."""
        with self._lock:
            self._ready, self._child, self.workers = False, None, 0
            pending, self._pending = self._pending, {}
        child.outbox.put(None)
        # It leaves the cluster when the connection ends.
        child.connection.close()
        try:
            child.process.wait(10.0)
        except subprocess.TimeoutExpired:
            child.process.kill()
            child.process.wait()
        for future in pending.values():
            future.set_exception(ClusterGone("the cluster is lost"))


def _received(connection: Connection) -> GatewayReply:
    return GatewayReply.read(connection.recv_bytes(MOST_FRAME))


def _write(child: _Child) -> None:
    """Write in a thread of its own: no thread of the server waits for a child that does not read."""
    try:
        while (item := child.outbox.get()) is not None:
            child.connection.send_bytes(item.packed())
    except (OSError, ValueError):
        pass  # The child has ended: the reader sees it.
