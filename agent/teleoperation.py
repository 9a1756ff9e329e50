"""Teleoperation, the robot's side: a person's newest velocity command, and what it is worth now."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from mapweave.agent.mission import Driven
from mapweave.agent.observation import FASTEST, Command
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.wire.log_messages import decode_record, encode_record

DEAD_MAN = 0.5
"""Without a command for so long the robot stands, s."""
STALE = 1.0
"""A command that was given later than this after the answer which it follows comes too late, s: it stops."""


@dataclass(frozen=True)
class DriveRequest:
    """A velocity command of a person.

    Attributes:
        session: random number of the program that the person drives with.
        command: wanted.
        answer_ns: `answer_ns` of the last answer that the program received; 0 for its first request.
        release: the person gives the wheels back to the mission.
    """

    session: int
    command: Command
    answer_ns: int = 0
    release: bool = False

    def encode(self) -> bytes:
        """As a flat record."""
        return encode_record(
            {
                "session": self.session,
                "forward": float(self.command.forward),
                "turn": float(self.command.turn),
                "answer_ns": self.answer_ns,
                "release": self.release,
            }
        )

    @staticmethod
    def decode(payload: bytes) -> DriveRequest:
        """Read a request.

        Raises:
            InvalidMessage: it is none.
        """
        values = decode_record(payload)
        session, answer_ns, release = (values.get(name) for name in ("session", "answer_ns", "release"))
        forward, turn = values.get("forward"), values.get("turn")
        if type(session) is not int or type(answer_ns) is not int or type(release) is not bool:
            raise InvalidMessage("drive: session and answer_ns must be whole numbers, release true or false")
        if type(forward) is not float or type(turn) is not float:
            raise InvalidMessage("drive: forward and turn must be numbers")
        if not (abs(forward) <= FASTEST and abs(turn) <= FASTEST):
            raise InvalidMessage(f"drive: forward and turn must be at most {FASTEST:g}")
        return DriveRequest(session, Command(forward, turn), answer_ns, release)


class Teleoperation:
    """Holds the newest command. A question is answered before the next is sent, so none wait in a queue.

    Thread-safe: requests come in the bus's thread, the robot's loop reads.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Nobody drives.

        Args:
            clock: ns, of this process alone.
        """
        self._clock = clock
        self._lock = threading.Lock()
        self._session: int | None = None
        self._command = Command()
        self._at_ns = 0

    def take(self, request: DriveRequest) -> int:
        """Take a command; returns the time of the answer, ns, which the next request repeats.

        Raises:
            InvalidValue: another program drives the robot now.
        """
        now = self._clock()
        with self._lock:
            if self._session not in (None, request.session) and now - self._at_ns < DEAD_MAN * 1e9:
                raise InvalidValue("another `mapweave drive` drives this robot")
            if request.release:
                self._session = None
                return now
            late = not 0 <= now - request.answer_ns <= STALE * 1e9
            self._session, self._at_ns = request.session, now
            self._command = Command() if late else request.command
        return now

    def release(self) -> None:
        """Give the wheels back to the mission."""
        with self._lock:
            self._session = None

    def driven(self) -> Driven | None:
        """The command that holds now; None where nobody drives."""
        with self._lock:
            if self._session is None:
                return None
            silence = (self._clock() - self._at_ns) * 1e-9
            return Driven(self._command) if silence < DEAD_MAN else Driven(Command(), silence)
