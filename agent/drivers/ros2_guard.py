"""The wheel guard of a robot behind ROS 2 topics: a process with a Zenoh session of its own."""

import json
import secrets
import subprocess
import sys
import time
from collections.abc import Mapping

from mapweave.agent.drivers.wheel_guard import SILENCE, WheelGuard, watch
from mapweave.hybridmap.errors import DeviceError
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.ros2.attachment import GID_BYTES, Attachment, encode_attachment
from mapweave.wire.ros2.entities import TopicPublication
from mapweave.wire.zenoh_bus import ZenohBus

PATIENCE = 3.0
"""s within which it reaches the router."""


class Ros2Guard(WheelGuard):
    """Handle of the guard process. It publishes what stops the wheels; otherwise it is a `WheelGuard`."""

    def __init__(self, endpoint: str, stop: Mapping[str, bytes]) -> None:
        """Start the process and wait until it can publish.

        Args:
            endpoint: Zenoh endpoint of the robot's router.
            stop: message that stops the wheels, for each key.

        Raises:
            DeviceError: it does not reach the router.
        """
        self.stop = dict(stop)
        messages = {key: payload.hex() for key, payload in stop.items()}
        command = [sys.executable, "-m", __name__, endpoint, json.dumps(messages)]
        self._start(command, subprocess.PIPE)
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            self.close()
            raise DeviceError(f"no router at {endpoint}: the wheel guard does not reach it")

    def close(self) -> None:
        """Stop the wheels and end the process."""
        super().close()
        if self._process.stdout is not None:
            self._process.stdout.close()


def main(endpoint: str, messages: Mapping[str, str]) -> None:
    """Run until the input ends."""
    bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
    gid, sequence = secrets.token_bytes(GID_BYTES), 0
    publications = [
        (bus.declare(TopicPublication(bus.owner, key, False)), bytes.fromhex(payload))
        for key, payload in messages.items()
    ]

    def stop() -> None:
        nonlocal sequence
        sequence += 1
        for publication, payload in publications:
            publication.put(payload, encode_attachment(Attachment(sequence, time.time_ns(), gid)))

    try:
        if bus.wait_connected(PATIENCE):
            print("ready", flush=True)
            watch(stop, SILENCE)
    finally:
        bus.close()


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
