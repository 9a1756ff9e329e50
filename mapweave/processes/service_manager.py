"""Messages to systemd, which restarts a process whose loop hangs; see sd_notify(3). Nothing without it."""

import contextlib
import os
import socket
import time

PERIOD = 1.0
"""s between two signs of life; the watchdog of the units waits 30 s."""
START = 600
"""s that a start may go on after each time that it says what it waits for; as TimeoutStartSec of the unit."""


class ServiceManager:
    """The datagram socket that systemd names in NOTIFY_SOCKET."""

    def __init__(self) -> None:
        """Look whether there is one."""
        # A name that begins with @ is in the abstract namespace of Linux.
        self._address = os.environ.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        self._next = 0.0

    def starts(self, words: str) -> None:
        """The start waits for something, which `systemctl status` shows; its time begins again."""
        self._send(f"EXTEND_TIMEOUT_USEC={START * 1_000_000}\nSTATUS={words}")

    def ready(self) -> None:
        """The process does its work from now on."""
        self._send("READY=1")

    def alive(self) -> None:
        """The loop turns. May be called at any rate."""
        if self._address and time.monotonic() >= self._next:
            self._next = time.monotonic() + PERIOD
            self._send("WATCHDOG=1")

    def _send(self, state: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as to:
            to.setblocking(False)
            to.sendto(state.encode(), self._address)
