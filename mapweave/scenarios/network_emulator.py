"""A network cable between a robot and the router that can be cut: a TCP forwarder on loopback.

TCP loses no single bytes. What is seen of a lossy radio are delays, stalls, little throughput and broken
connections: that is what this does.
"""

import contextlib
import math
import socket
import threading
import time

import numpy as np

RESEND = 0.2
"""What TCP loses it sends again after about this, s."""

SEGMENT = 1448
"""Bytes that TCP sends at once over Ethernet."""
LEAST_RATE = 2000.0
"""However many segments are lost, bytes a second."""
CHUNK = 65536
"""Bytes that are read at once."""
THAW = 0.05
"""How often it is looked whether a frozen cable is one no longer, s."""


class NetworkEmulator:
    """Forwards connections to one port of this machine.

    Attributes:
        port: where the robot connects.
        carried: bytes in both directions so far.
    """

    def __init__(self, target_port: int, seed: int) -> None:
        """Listen on a free port, and forward to the router's; the seed is that of the losses."""
        self._target = target_port
        self._random = np.random.default_rng([seed, 0xCAB1E])
        self._lock = threading.Lock()
        self._open: set[tuple[socket.socket, socket.socket]] = set()
        self._cut = False
        self._loss = 0.0
        self._delay = 0.0
        self._rate = math.inf
        self._lost_segments = 0.0
        self._frozen = False
        self.carried = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, name=f"emulator-{self.port}", daemon=True).start()

    def cut(self) -> None:
        """Break every connection and take no new one."""
        with self._lock:
            self._cut = True
            ends = [end for pair in self._open for end in pair]
            self._open.clear()
        for end in ends:
            _break(end)

    def worsen(self, loss: float, delay: float, rate: float = math.inf) -> None:
        """Delay every piece; a share of them arrives only after being sent again; so many bytes a second."""
        with self._lock:
            self._loss, self._delay, self._rate = loss, delay, rate

    def lose_segments(self, share: float, delay: float) -> None:
        """Lose a share of the segments, as on a lossy radio.

        A lost segment holds up all that is behind it until it comes again: TCP waits `RESEND`, then each time
        twice as long. And TCP takes losses for congestion: its rate is what Mathis et al. found (1997), 1.22
        segments per time there and back and root of the share.

        Args:
            share: 0 to below 1.
            delay: of each segment, one way, s.
        """
        rate = 1.22 * SEGMENT / (2.0 * delay * math.sqrt(share)) if share and delay else math.inf
        with self._lock:
            self._lost_segments, self._delay, self._rate = share, delay, max(rate, LEAST_RATE)

    def freeze(self) -> None:
        """Let nothing through; no end learns of it."""
        with self._lock:
            self._frozen = True

    def half_close(self) -> None:
        """End the way back of each connection: the robot may go on sending, and no answer comes."""
        with self._lock:
            robots = [robot for robot, _ in self._open]
        for robot in robots:
            with contextlib.suppress(OSError):
                robot.shutdown(socket.SHUT_WR)

    def restore(self) -> None:
        """Forward again, at once and without losses."""
        with self._lock:
            self._cut = self._frozen = False
            self._loss, self._delay, self._rate = 0.0, 0.0, math.inf
            self._lost_segments = 0.0

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
                    self._open.add((robot, router))
            if refused:
                _break(robot)
                _break(router)
                continue
            for back in (False, True):
                threading.Thread(target=self._pump, args=((robot, router), back), daemon=True).start()

    def _pump(self, pair: tuple[socket.socket, socket.socket], back: bool) -> None:
        source, sink = pair[::-1] if back else pair
        while True:
            try:
                data = source.recv(CHUNK)
            except OSError:
                data = b""
            if not data:
                break
            with self._lock:
                self.carried += len(data)
                pause = self._pause(len(data))
            if pause:
                time.sleep(pause)
            while self._frozen and not self._cut:
                time.sleep(THAW)
            try:
                sink.sendall(data)
            except OSError:
                break
        with self._lock:
            self._open.discard(pair)
        for end in pair:
            _break(end)

    def _pause(self, size: int) -> float:
        """How long a piece of so many bytes takes, s; with the lock held."""
        pause = self._delay + size / self._rate
        if self._loss:
            pause += RESEND * float(self._random.geometric(1.0 - self._loss) - 1)
        if self._lost_segments:
            # Lost ones of a piece are sent again side by side: it waits for the one that is lost most often.
            tries = self._random.geometric(1.0 - self._lost_segments, math.ceil(size / SEGMENT))
            pause += RESEND * (2.0 ** (int(tries.max()) - 1) - 1.0)
        return pause


def _break(end: socket.socket) -> None:
    # Threads in recv or accept are woken by shutdown, not by close.
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()
