"""Serial ports of this computer."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

DEVICES = Path("/dev")
PATTERNS = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*", "rfcomm*", "cu.usb*")
"""USB adapters, boards, UARTs of a Raspberry Pi and of a Jetson, Bluetooth, macOS; pyserial knows more."""


@dataclass(frozen=True)
class FoundPort:
    """One port.

    Attributes:
        path: of the device.
        description: of what is plugged in; empty if it is unknown.
        stable: a path that stays the same whatever else is plugged in; empty if there is none.
        usable: whether this user may open it.
    """

    path: str
    description: str
    stable: str
    usable: bool

    @property
    def line(self) -> str:
        """The port in one line."""
        parts = [self.path, self.description, f"always at {self.stable}" if self.stable else ""]
        if not self.usable:
            parts.append("may not be opened: add your user to the group dialout and log in again")
        return "  ".join(part for part in parts if part)


def serial_ports(devices: Path = DEVICES) -> list[FoundPort]:
    """All serial ports, by their paths."""
    by_id = {_target(link): str(link) for link in sorted((devices / "serial" / "by-id").glob("*"))}
    known = _descriptions()
    paths = {path for pattern in PATTERNS for path in devices.glob(pattern) if path.exists()}
    paths |= {path for path in map(Path, known) if path.parent == devices}
    return [
        FoundPort(
            str(path), known.get(str(path), ""), by_id.get(_target(path), ""),
            os.access(path, os.R_OK | os.W_OK),
        )
        for path in sorted(paths)
    ]  # fmt: skip


def gone(before: Sequence[FoundPort], after: Sequence[FoundPort]) -> list[FoundPort]:
    """Ports that were there and are no longer."""
    left = {port.path for port in after}
    return [port for port in before if port.path not in left]


def _target(path: Path) -> str:
    """Where a link leads; empty if it is pulled out at this moment."""
    try:
        return str(path.resolve())
    except OSError:
        return ""


def _descriptions() -> dict[str, str]:
    """What USB says of its devices, by their paths; nothing without pyserial."""
    try:
        from serial.tools import list_ports
    except ImportError:
        return {}
    return {
        port.device: "" if port.description == "n/a" else port.description for port in list_ports.comports()
    }
