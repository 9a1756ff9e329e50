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
VERSION_REQUEST, AXES_REQUEST = 0x80046A01, 0x80016A11
"""JSIOCGVERSION and JSIOCGAXES of linux/joystick.h: only the joystick interface answers them."""
ADVICE = "give its device, --gamepad /dev/input/js1"
HELP = "the left stick drives, any button stops while it is pressed"
HELD = "let go of the left stick, it is at {:+.0%} of its way; if it rests there, calibrate it: jscal -c"


class Gamepad:
    """What the left stick wants. One that is not in the middle at the start wants nothing until it was.

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
        self._seen: set[int] = set()
        self._held: set[int] = set()
        self._pressed: set[int] = set()
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise DeviceError(f"gamepad {path}: {error.strerror}; connect it, or {ADVICE}") from None
        axes = _axes(self._fd)
        if axes is None or axes <= max(self._axes):
            os.close(self._fd)
            lacks = "is no joystick device (an event device is none)"
            if axes is not None:
                lacks = f"has {axes} axes, and a stick has two"
            raise DeviceError(f"gamepad {path}: {lacks}; {ADVICE}")

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
                share = self._axes[number] = max(value / FULL, -1.0)
                if abs(share) <= DEAD_ZONE:
                    self._held.discard(number)
                elif kind & INIT and number not in self._seen:
                    # Held as the drive begins; or a pad that has sent no state yet, which reads as an end.
                    self._held.add(number)
                self._seen.add(number)
            elif kind & ~INIT == BUTTON:
                (self._pressed.add if value else self._pressed.discard)(number)

    def wanted(self) -> tuple[float, float]:
        """Forward and turn, each a share of the robot's limit, -1 to 1; turn is positive to the left."""
        if self._pressed or self._held:
            return 0.0, 0.0
        return self._share(FORWARD_AXIS), self._share(TURN_AXIS)

    @property
    def hint(self) -> str:
        """What the person should know now."""
        if self._held:
            return HELD.format(max((self._axes[axis] for axis in self._held), key=abs))
        return HELP

    def _share(self, axis: int) -> float:
        value = -self._axes[axis]
        return self._speed * value if abs(value) > DEAD_ZONE else 0.0

    def close(self) -> None:
        """Close the device."""
        os.close(self._fd)


def _axes(fd: int) -> int | None:
    """How many axes an open file has; None if it gives no joystick events.

    A pipe may give those of another program, and is taken for a gamepad of two axes.
    """
    if stat.S_ISFIFO(os.fstat(fd).st_mode):
        return 2
    count = bytearray(1)
    try:
        fcntl.ioctl(fd, VERSION_REQUEST, bytes(4))
        fcntl.ioctl(fd, AXES_REQUEST, count)
    except OSError:
        return None
    return count[0]
