"""A robot whose base is behind the bus: the simulator, or a computer on a real robot."""

import logging
import secrets
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from mapweave.agent.drivers.messages import (
    AGAIN,
    ENDED,
    StepRequest,
    check_image,
    decode_description,
    decode_observation,
    encode_step,
)
from mapweave.agent.drivers.robot import clip
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.errors import DeviceError, InvalidMessage
from mapweave.wire.bus import Bus, Closing
from mapweave.wire.keys import Keys

log = logging.getLogger(__name__)

ASK_TIMEOUT = 2.0
"""After what silence a question is asked again, and the wait is logged, s. A lost question costs no more."""

PATIENCE = 90.0
"""Longest silence of a base, s. A simulated base is silent while it waits for the agents of other robots."""

START = "start the robot's base (for a simulated one: mapweave sim serve) with the same fleet and endpoint"
WAITS = "a simulated base (mapweave sim serve) waits for the agents of all its robots: start these as well"
PAUSE = 0.05
"""Between two questions while there is no answer, s."""

_T = TypeVar("_T")


class RemoteRobot:
    """A robot base behind Zenoh keys: simulated, or in any language (docs/wire.md).

    Each `sense` carries the last command there and the observation back: one question a tick.
    """

    def __init__(self, bus: Bus, fleet: str, name: str, patience: float = PATIENCE) -> None:
        """Prepare the client.

        Args:
            bus: the connection.
            fleet: which fleet.
            name: the robot's.
            patience: how long to repeat a question without an answer, s; longer than a bridge waits for
                its other robots.
        """
        keys = Keys(fleet)
        self._bus = bus
        self._describe_key = keys.robot_describe(name)
        self._step_key = keys.robot_step(name)
        self._patience = patience
        self._sequence = 0
        self._command = Command()
        self._description: RobotDescription | None = None
        self._closed = threading.Event()
        # A base waits for its driver only while it runs.
        self._alive: Closing = bus.announce(keys.robot_driver(name, secrets.randbits(52)))

    def describe(self) -> RobotDescription:
        """Description of the robot; asked once.

        Raises:
            DeviceError: no answer, or a malformed one.
        """
        if self._description is None:
            self._description = self._ask(self._describe_key, b"", decode_description)
            if self._description is None:
                why = "stopped before its base has answered" if self._closed.is_set() else ENDED
                raise DeviceError(f"{self._describe_key}: {why}")
        return self._description

    def sense(self) -> Observation | None:
        """Let the last command act for one tick; None when the base has ended.

        Raises:
            DeviceError: no answer, or a malformed one.
        """
        if self._closed.is_set():
            return None
        # Counted when it is answered: a step that failed is asked again under its own number.
        number = self._sequence + 1
        step, standing = StepRequest(number, self._command), StepRequest(number, Command())
        description = self.describe()

        def decode(data: bytes) -> Observation:
            observation = decode_observation(data)
            check_image(observation, description)
            return observation

        observation = self._ask(self._step_key, encode_step(step), decode, encode_step(standing))
        self._sequence += 1
        return observation

    def act(self, command: Command) -> Command:
        """Keep the command for the next tick.

        Returns:
            The command within the base's limits.

        Raises:
            DeviceError: the limits are unknown and the base does not answer.
            InvalidValue: the command is not finite.
        """
        self._command = clip(command, self.describe())
        return self._command

    def close(self) -> None:
        """Stop asking. A base stops by itself when its agent no longer asks or has died."""
        self._closed.set()
        self._alive.close()

    def _ask(
        self, key: str, payload: bytes, decode: Callable[[bytes], _T], after_restart: bytes | None = None
    ) -> _T | None:
        """Ask until there is an answer; None if there will be none, or this robot was closed.

        An answer that is not valid is asked for once more: it may have been damaged on its way. A base that
        has been gone is asked `after_restart`, if given: it must not drive an old command.
        """
        begin = time.monotonic()
        end = begin + self._patience
        reason = "no answer"
        asked_again = reported = False
        while True:
            # A short patience still gives every question time for its answer.
            timeout = min(ASK_TIMEOUT, max(end - time.monotonic(), PAUSE))
            asked_at = time.monotonic()
            replies = self._bus.ask(key, payload, timeout)
            # A question that no base serves ends at once; a slow base keeps it until the time-out.
            gone = not replies and time.monotonic() - asked_at < timeout
            answers = [reply.payload for reply in replies if not reply.error]
            if len(answers) > 1:
                raise DeviceError(f"{key}: {len(answers)} bases answer; stop all but one")
            if answers:
                if reported:
                    log.warning("%s: the base answers", key)
                try:
                    return decode(answers[0])
                except InvalidMessage as error:
                    if asked_again:
                        raise DeviceError(f"{key}: {error}") from error
                    asked_again = True
                    continue
            for reply in replies:
                reason = reply.error
                if reason == ENDED:
                    return None
                if AGAIN not in reason:
                    raise DeviceError(f"{key}: refused: {reason}")
            now = time.monotonic()
            if now >= end:
                raise DeviceError(f"{key}: {reason} for {self._patience:g} s; {START if gone else WAITS}")
            if now - begin >= ASK_TIMEOUT:
                if not reported:
                    why = f"no answer yet; {START}" if self._description is None else _cause(gone)
                    log.warning("%s: %s; the agent waits up to %g s", key, why, self._patience)
                    reported = True
                if gone and after_restart is not None:
                    payload = after_restart
            if self._closed.wait(PAUSE):
                return None


def _cause(gone: bool) -> str:
    """Why there is no answer, and what to do."""
    if gone:
        return "the base is gone, start it again"
    return "no answer from the base (a simulated one waits for the agents of all its robots)"
