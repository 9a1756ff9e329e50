"""A network cable between a robot and the router that can be cut: a TCP forwarder on loopback."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

import numpy as np

RESEND = 0.2
"""What TCP loses it sends again after about this, s."""

CHUNK = 65536


class NetworkEmulator:
    """Forwards connections to one port of this machine.

    Attributes:
        port: where the robot connects.
        carried: bytes in both directions so far.
    """

    def __init__(self, target_port: int, seed: int) -> None:
        """Listen on a free port, and forward to another.

        Args:
            target_port: of the router.
            seed: of the losses.
        """
        self._target = target_port
        self._random = np.random.default_rng([seed, 0xCAB1E])
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._cut = False
        self._loss = 0.0
        self._delay = 0.0
        self.carried = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, name=f"emulator-{self.port}", daemon=True).start()

    def cut(self) -> None:
        """Break every connection and take no new one."""
        with self._lock:
            self._cut = True
            ends = list(self._open)
            self._open.clear()
        for end in ends:
            _break(end)

    def worsen(self, loss: float, delay: float) -> None:
        """Delay every piece; a share of them arrives only after being sent again."""
        with self._lock:
            self._loss, self._delay = loss, delay

    def restore(self) -> None:
        """Forward again, at once and without losses."""
        with self._lock:
            self._cut = False
            self._loss = self._delay = 0.0

    def close(self) -> None:
        """Break everything for good."""
        _break(self._listener)
        self.cut()

    def _accept(self) -> None:
        while True:
            try:
                robot, _ = self._listener.accept()
            except OSError:
                return
            try:
                router = socket.create_connection(("127.0.0.1", self._target), 2.0)
            except OSError:
                _break(robot)
                continue
            router.settimeout(None)
            for end in (robot, router):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                refused = self._cut
                if not refused:
                    self._open |= {robot, router}
            if refused:
                _break(robot)
                _break(router)
                continue
            for source, sink in ((robot, router), (router, robot)):
                threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        while True:
            try:
                data = source.recv(CHUNK)
            except OSError:
                data = b""
            if not data:
                break
            with self._lock:
                self.carried += len(data)
                pause = self._delay
                if self._loss:
                    pause += RESEND * float(self._random.geometric(1.0 - self._loss) - 1)
            if pause:
                time.sleep(pause)
            try:
                sink.sendall(data)
            except OSError:
                break
        with self._lock:
            self._open -= {source, sink}
        for end in (source, sink):
            _break(end)


def _break(end: socket.socket) -> None:
    # Threads in recv or accept are woken by shutdown, not by close.
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()
