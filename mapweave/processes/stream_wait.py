"""An agent that starts before its network camera, as both do after a power cut, waits for its stream."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from mapweave.agent.drivers.camera import StreamAway
from mapweave.agent.drivers.stream_refusal import refusal
from mapweave.processes.service_manager import ServiceManager

Made = TypeVar("Made")

EVERY = 1.0
"""s between two attempts."""


def made_with_stream(make: Callable[[], Made], log: Callable[[str], None], stop: threading.Event) -> Made:
    """Make what needs the stream of a camera, and try again until the stream answers.

    A server that serves one program after the other, as `rpicam-vid`, is asked only while it does not open.

    Args:
        make: fails with StreamAway where the stream does not answer yet, and otherwise where waiting does not
            help.
        log: gets a line when the wait begins, and one when it has ended.
        stop: ends the wait.

    Raises:
        StreamAway: stopped meanwhile.
        MapweaveError: waiting does not help.
    """
    manager, began, waits = ServiceManager(), time.monotonic(), False
    while True:
        try:
            made = make()
        except StreamAway as error:
            if stop.is_set():
                raise
            if not waits:
                waits = True
                log(f"waits for its stream: {error}")
            while True:
                manager.starts(f"waiting: {error}")
                if stop.wait(EVERY):
                    raise
                if not refusal(error.url).may_pass:
                    break
        else:
            if waits:
                log(f"the stream is there, after {time.monotonic() - began:.0f} s")
            return made
