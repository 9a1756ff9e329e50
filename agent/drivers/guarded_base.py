"""What bases on a serial line without a hardware watchdog share."""

from __future__ import annotations

from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.agent.drivers.wheel_guard import WheelGuard


class GuardedBase:
    """An open port and the guard that stops the wheels behind it."""

    def __init__(self, path: str) -> None:
        """Create a base without opening its port."""
        self._path = path
        self._port: SerialPort | None = None
        self._guard: WheelGuard | None = None

    def close(self) -> None:
        """Stop the wheels by the guard, and close the port."""
        if self._guard is not None:
            self._guard.close()
            self._guard = None
        if self._port is not None:
            self._port.close()
            self._port = None
