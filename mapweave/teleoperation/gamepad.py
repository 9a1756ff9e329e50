"""Velocity commands from a gamepad by Linux's joystick interface.

https://docs.kernel.org/input/joydev/joystick-api.html: each event is a `js_event` of 8 bytes: time in ms
(u32), value (s16), type (u8: 1 button, 2 axis, with 0x80 for the state at the opening), number (u8).
"""

import fcntl
import os
import stat
import struct
from pathlib import Path

from mapweave.hybridmap.errors import DeviceError

EVENT = struct.Struct("=IhBB")
BUTTON, AXIS, INIT = 0x01, 0x02, 0x80
"""Kinds of events, by linux/joystick.h."""
FULL = 32767
"""Value of an axis at its end."""
TURN_AXIS, FORWARD_AXIS = 0, 1
"""The left stick: to the right and to the back are positive."""
DEAD_ZONE = 0.1
"""A stick that is let go rests within this share of its way."""
VERSION_REQUEST = 0x80046A01
"""JSIOCGVERSION of linux/joystick.h: only the joystick interface answers it."""
ADVICE = "give its device, --gamepad /dev/input/js1"
HELP = "the left stick drives, any button stops while it is pressed"


class Gamepad:
    """What the left stick wants.

    Attributes:
        path: of the device.
    """

    def __init__(self, path: Path, speed: float) -> None:
        """Open the device.

        Args:
            path: for example /dev/input/js0.
            speed: share of the robot's limits at full deflection, 0 to 1.

        Raises:
            DeviceError: it cannot be opened.
        """
        self.path = path
        self._speed = speed
        self._rest = b""
        self._axes = {TURN_AXIS: 0.0, FORWARD_AXIS: 0.0}
        self._pressed: set[int] = set()
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise DeviceError(f"gamepad {path}: {error.strerror}; connect it, or {ADVICE}") from None
        if not _is_joystick(self._fd):
            os.close(self._fd)
            raise DeviceError(f"gamepad {path}: is no joystick device (an event device is none); {ADVICE}")

    def fileno(self) -> int:
        """The file descriptor for `select`."""
        return self._fd

    def read(self) -> None:
        """Take the events that are there.

        Raises:
            DeviceError: the device is gone.
        """
        try:
            data = os.read(self._fd, 64 * EVENT.size)
        except BlockingIOError:
            return
        except OSError as error:
            raise DeviceError(f"gamepad {self.path}: {error.strerror}") from None
        if not data:
            raise DeviceError(f"gamepad {self.path}: it is gone")
        self._rest += data
        while len(self._rest) >= EVENT.size:
            event, self._rest = self._rest[: EVENT.size], self._rest[EVENT.size :]
            _, value, kind, number = EVENT.unpack(event)
            if kind & ~INIT == AXIS and number in self._axes:
                self._axes[number] = max(value / FULL, -1.0)
            elif kind & ~INIT == BUTTON:
                (self._pressed.add if value else self._pressed.discard)(number)

    def wanted(self) -> tuple[float, float]:
        """Forward and turn, each a share of the robot's limit, -1 to 1; turn is positive to the left."""
        if self._pressed:
            return 0.0, 0.0
        return self._share(FORWARD_AXIS), self._share(TURN_AXIS)

    def _share(self, axis: int) -> float:
        value = -self._axes[axis]
        return self._speed * value if abs(value) > DEAD_ZONE else 0.0

    def close(self) -> None:
        """Close the device."""
        os.close(self._fd)


def _is_joystick(fd: int) -> bool:
    """Whether an open file gives joystick events; a pipe may give those of another program."""
    if stat.S_ISFIFO(os.fstat(fd).st_mode):
        return True
    try:
        fcntl.ioctl(fd, VERSION_REQUEST, bytes(4))
    except OSError:
        return False
    return True
