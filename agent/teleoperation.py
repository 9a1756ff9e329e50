"""Teleoperation, the robot's side: a person's newest velocity command, and what it is worth now."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

from mapweave.agent.mission import Driven
from mapweave.agent.observation import Command
from mapweave.hybridmap.agent_status import HandDrive
from mapweave.hybridmap.drive_request import DriveRequest
from mapweave.hybridmap.errors import InvalidValue

DEAD_MAN = 0.5
"""Without a command for so long the robot stands, s."""
STALE = 1.0
"""A command that was given later than this after the answer which it follows comes too late, s: it stops."""


class Teleoperation:
    """Holds the newest command. A question is answered before the next is sent, so none wait in a queue.

    Thread-safe: requests come in the bus's thread, the robot's loop reads.
    """

    def __init__(
        self,
        clock: Callable[[], int] = time.monotonic_ns,
        refusal: str = "",
        time_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """No one drives.

        Args:
            clock: ns, of this process alone.
            refusal: why no commands are taken; empty if they are.
            time_ns: wall time, by which a drive is recorded.
        """
        self._time_ns = time_ns
        self._drive: HandDrive | None = None
        self._refusal = refusal
        self._clock = clock
        self._lock = threading.Lock()
        self._session: int | None = None
        self._command = Command()
        self._at_ns = 0

    @property
    def drive(self) -> HandDrive | None:
        """Who drives, or has last; None if no one has. From any thread."""
        with self._lock:
            return self._drive

    def take(self, request: DriveRequest) -> int:
        """Take a command; returns the time of the answer, ns, which the next request repeats.

        Raises:
            InvalidValue: another program drives the robot now, or no commands are taken.
        """
        if self._refusal:
            raise InvalidValue(self._refusal)
        now = self._clock()
        with self._lock:
            if self._session not in (None, request.session) and now - self._at_ns < DEAD_MAN * 1e9:
                raise InvalidValue("another `mapweave drive` drives this robot")
            if request.release:
                self._end()
                return now
            if request.session != self._session:
                self._drive = HandDrive(request.by, self._time_ns())
            late = not 0 <= now - request.answer_ns <= STALE * 1e9
            self._session, self._at_ns = request.session, now
            self._command = Command() if late else Command(request.forward, request.turn)
        return now

    def release(self) -> None:
        """Give the wheels back to the mission."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        self._session = None
        if self._drive is not None:
            self._drive = replace(self._drive, over=True)

    def driven(self) -> Driven | None:
        """The command that holds now; None if no one drives."""
        with self._lock:
            if self._session is None:
                return None
            silence = (self._clock() - self._at_ns) * 1e-9
            return Driven(self._command) if silence < DEAD_MAN else Driven(Command(), silence)
