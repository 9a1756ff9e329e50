"""A drive: the newest command goes to the agent with a question, and the next waits for the answer.

So no commands queue up on a slow network. The robot stands when no command arrives for 0.5 s.
"""

from __future__ import annotations

import secrets
import threading
import time

from mapweave.agent.observation import Command
from mapweave.agent.teleoperation import DEAD_MAN
from mapweave.hybridmap.drive_request import DriveAnswer, DriveRequest
from mapweave.hybridmap.errors import DeviceError, MapweaveError
from mapweave.wire.bus import Bus
from mapweave.wire.each_robot import alive_robots
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import sent_by

PERIOD = 0.1
"""Between two commands at the most, s."""
FIRST = 1.0
"""How long the agent may take for its first answer, s."""


class Session:
    """Sends commands in a thread of its own until it is closed; then the mission goes on.

    If it is closed by an error, as that a gamepad is gone, the robot stands instead.

    Attributes:
        answer: the agent's last one; None before the first.
        answered: when it came, s of `time.monotonic`.
        refused: why the agent takes no commands; empty if it does.
    """

    def __init__(self, bus: Bus, keys: Keys, name: str, by: str = "", sender: str = "") -> None:
        """Take the wheels.

        Args:
            bus: connected.
            keys: of the fleet.
            name: of the agent.
            by: who drives, for the history.
            sender: holder of the key with which the bus is connected; empty without one.

        Raises:
            DeviceError: no such agent answers, or it refuses.
        """
        self.answer: DriveAnswer | None = None
        self.answered = 0.0
        self.refused = ""
        self._bus, self._keys, self._name, self._by = bus, keys, name, by[:64]
        self._key = sent_by(keys.drive(name), sender)
        self._number = secrets.randbits(52)
        self._shares = (0.0, 0.0)
        self._changed = threading.Event()
        self._closing = self._failed = False
        self._sender = threading.Thread(target=self._send_all, name="commands", daemon=True)
        end = time.monotonic() + FIRST
        while self.answer is None and not self.refused:
            self._send(FIRST)
            if self.answer is None and time.monotonic() >= end:
                raise DeviceError(self._absent())
        if self.refused:
            raise DeviceError(f"{name}: {self.refused}")

    def __enter__(self) -> Session:
        """Begin to send."""
        self._sender.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Give the wheels back, or stop them: no person has quit where an error ends the drive."""
        self._failed = kind is not None
        self._shares = 0.0, 0.0
        self._closing = True
        self._changed.set()
        self._sender.join()

    def want(self, forward: float, turn: float) -> None:
        """What the person wants now, each a share of the robot's limit, -1 to 1; a change is sent at once."""
        changed = (forward, turn) != self._shares
        self._shares = forward, turn
        if changed:
            self._changed.set()

    @property
    def command(self) -> Command:
        """What the person wants now."""
        if self.answer is None:
            return Command()
        forward, turn = self._shares
        return Command(forward * self.answer.max_forward, turn * self.answer.max_turn)

    def _send_all(self) -> None:
        while not self._closing and not self.refused:
            self._changed.clear()
            began = time.monotonic()
            self._send(DEAD_MAN)
            self._changed.wait(max(began + PERIOD - time.monotonic(), 0.0))
        if not self.refused:
            self._send(DEAD_MAN, release=not self._failed)

    def _send(self, timeout: float, release: bool = False) -> None:
        answer_ns = 0 if self.answer is None else self.answer.answer_ns
        command = Command() if release else self.command
        request = DriveRequest(self._number, command.forward, command.turn, answer_ns, release, self._by)
        for reply in self._bus.ask(self._key, encode(request), timeout):
            if reply.error:
                self.refused = reply.error
                return
            try:
                self.answer, self.answered = decode(reply.payload, DriveAnswer), time.monotonic()
            except MapweaveError as error:
                self.refused = str(error)

    def _absent(self) -> str:
        """That the agent does not answer, and who is there."""
        others = ", ".join(name for name in alive_robots(self._bus, self._keys) if name != self._name)
        rest = f"; there are {others}" if others else ""
        return f"no agent {self._name} in fleet {self._keys.fleet}: start `mapweave agent {self._name}`{rest}"
