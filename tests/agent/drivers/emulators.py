"""Robots on real lines: a pseudo-terminal or a socket with wheels behind it, which may stall or vanish.

The bytes are written by hand from the manuals; nothing here knows a driver.
"""

import contextlib
import os
import pty
import select
import struct
import termios
import threading
import time
import tty
from pathlib import Path
from typing import ClassVar


class TwoWheels:
    """Wheels that turn at once as they are commanded; what they really do is the tests' truth."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._since = time.monotonic()
        self.speeds = (0.0, 0.0)
        self.commanded: list[tuple[float, float]] = []
        """All speeds so far."""
        self._way = (0.0, 0.0)
        self.stopped_at = self._since

    def set(self, left: float, right: float) -> None:
        """Speeds, m/s."""
        with self._lock:
            self._advance()
            if (left, right) == (0.0, 0.0) != self.speeds:
                self.stopped_at = self._since
            self.speeds = (left, right)
            self.commanded.append(self.speeds)

    def way(self) -> tuple[float, float]:
        """m, of each wheel so far."""
        with self._lock:
            self._advance()
            return self._way

    def _advance(self) -> None:
        now = time.monotonic()
        dt, self._since = now - self._since, now
        self._way = (self._way[0] + self.speeds[0] * dt, self._way[1] + self.speeds[1] * dt)


class Emulator:
    """A robot at the far end of a pseudo-terminal, which stands under `path` as long as it is plugged in.

    Attributes:
        path: of the port.
        wheels: what drives.
        stalled: whether it neither reads nor answers.
        heard: all bytes that came.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / "port"
        self.wheels = TwoWheels()
        self.stalled = False
        self.heard = b""
        self._closing = False
        self._master = self._slave = -1
        self._lock = threading.RLock()
        self.plug_in()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def plug_in(self) -> None:
        with self._lock:
            self._master, self._slave = pty.openpty()
            tty.setraw(self._slave)
            self.path.symlink_to(os.ttyname(self._slave))
            self.switched_on()

    def unplug(self) -> None:
        """The port vanishes, as a USB adapter does; the wheels go on as they were commanded."""
        with self._lock:
            self.path.unlink()
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def line_settings(self) -> tuple[int, int]:
        """Baud constant and stop bits that the driver has set."""
        attributes = termios.tcgetattr(self._master)
        return attributes[5], 2 if attributes[2] & termios.CSTOPB else 1

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        if self._master >= 0:
            self.unplug()

    # For those who write a robot.

    def switched_on(self) -> None:
        """Begin as after power on."""

    def take(self, data: bytes) -> None:
        """Bytes from the driver."""
        raise NotImplementedError

    def idle(self) -> None:
        """Called every few milliseconds."""

    def say(self, data: bytes) -> None:
        with self._lock, contextlib.suppress(OSError):
            if self._master >= 0:
                os.write(self._master, data)

    def _serve(self) -> None:
        while not self._closing:
            master = self._master
            if master < 0 or self.stalled:
                time.sleep(0.005)
                self.idle()
                continue
            try:
                ready, _, _ = select.select([master], [], [], 0.005)
                data = os.read(master, 4096) if ready else b""
            except (OSError, ValueError):
                time.sleep(0.005)
                continue
            if data:
                self.heard += data
                self.take(data)
            self.idle()


class LineEmulator(Emulator):
    """One that takes lines."""

    def switched_on(self) -> None:
        self._rest = b""

    def take(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        for line in lines:
            if line:
                self.line(line.decode("ascii", "replace"))

    def line(self, line: str) -> None:
        raise NotImplementedError


class KoalaSilver(LineEmulator):
    """Koala silver edition: user manual, appendix "Communication protocol to control the robot"."""

    BAUD, STOP_BITS = termios.B38400, 2

    def switched_on(self) -> None:
        super().switched_on()
        self.wheels.set(0.0, 0.0)
        self.infrared = [0] * 16

    def line(self, line: str) -> None:
        if self.line_settings() != (self.BAUD, self.STOP_BITS):
            return  # noise to a line that is set otherwise
        name, *arguments = line.split(",")
        match name, [int(a) for a in arguments]:
            case "B", []:
                self.say(b"b,5.02,5.02\r\n")
            case "D", [left, right] if abs(left) <= 127 and abs(right) <= 127:
                # "Set speed: the unit is the pulse / 10 ms, that corresponds to 4.5 mm/s".
                self.wheels.set(left * 0.0045, right * 0.0045)
                self.say(b"d\r\n")
            case "H", []:
                # "Read position: the unit is the pulse, 0.045 mm".
                left, right = (round(way / 0.045e-3) for way in self.wheels.way())
                self.say(f"h,{left},{right}\r\n".encode())
            case "N", []:
                self.say(("n," + ",".join(map(str, self.infrared)) + "\r\n").encode())
            case _:
                self.say(b"z,Protocol error\r\n")


class Koala25(LineEmulator):
    """Koala 2.5: user manual 1.1, section 6 "Serial communication protocol", and 4.1 on the sensors."""

    BAUD, STOP_BITS = termios.B115200, 1
    PULSE = 3.141592653589793 * 82.5e-3 / 23400

    def switched_on(self) -> None:
        super().switched_on()
        self.wheels.set(0.0, 0.0)
        self.ultrasonic = [1000] * 9

    def line(self, line: str) -> None:
        if self.line_settings() != (self.BAUD, self.STOP_BITS):
            return
        name, *arguments = line.split(",")
        match name, [int(a) for a in arguments]:
            case "B", []:
                self.say(b"b,A-02\r\n")
            case "D", [left, right]:
                # "Set speed: pulses per 10 ms".
                self.wheels.set(left * self.PULSE * 100, right * self.PULSE * 100)
                self.say(b"d\r\n")
            case "P", []:
                left, right = (round(way / self.PULSE) for way in self.wheels.way())
                self.say(f"p,{left},{right}\r\n".encode())
            case "G", []:
                self.say(("g," + ",".join(map(str, self.ultrasonic)) + "\r\n").encode())
            case _:
                self.say(b"#\r\n")


class Create2(Emulator):
    """Create 2: Open Interface specification, "Open Interface commands" and "Sensor packets"."""

    LENGTHS: ClassVar = {7: 0, 128: 0, 131: 0, 132: 0, 145: 4, 149: None, 173: 0}

    def switched_on(self) -> None:
        self._data = b""
        self.mode = 0
        self.bumps = 0
        self.charge = 2022
        self.wheels.set(0.0, 0.0)

    def lift(self) -> None:
        """A wheel drops: the wheels stop, and the mode is Passive (specification, "Safe Mode")."""
        self.mode = 1
        self.wheels.set(0.0, 0.0)

    def take(self, data: bytes) -> None:
        if self.line_settings() != (termios.B115200, 1):
            return
        self._data += data
        while self._data:
            opcode = self._data[0]
            if opcode not in self.LENGTHS:
                self._data = self._data[1:]
                continue
            length = self.LENGTHS[opcode]
            if length is None:
                length = 1 + self._data[1] if len(self._data) > 1 else 1
            if len(self._data) < 1 + length:
                return
            arguments, self._data = self._data[1 : 1 + length], self._data[1 + length :]
            self._obey(opcode, arguments)

    def _obey(self, opcode: int, arguments: bytes) -> None:
        if opcode == 128 and self.mode == 0:
            self.mode = 1
        elif opcode in (131, 132) and self.mode:
            self.mode = opcode - 129
        elif opcode == 145 and self.mode in (2, 3):
            # "Right velocity high byte, low byte, left velocity high byte, low byte", mm/s.
            right, left = struct.unpack(">hh", arguments)
            if max(abs(right), abs(left)) <= 500:
                self.wheels.set(left / 1000, right / 1000)
        elif opcode == 149 and self.mode:
            self.say(b"".join(self._packet(number) for number in arguments[1:]))

    def _packet(self, number: int) -> bytes:
        # "Left/right encoder counts": 508.8 a turn of a 72 mm wheel, unsigned, 16 bit, high byte first.
        left, right = (round(way / (3.141592653589793 * 72e-3) * 508.8) for way in self.wheels.way())
        return {
            7: bytes([self.bumps]),
            # "Battery charge" and "Battery capacity": unsigned, 16 bit, mAh.
            25: struct.pack(">H", self.charge),
            26: struct.pack(">H", 2696),
            35: bytes([self.mode]),
            43: struct.pack(">H", left % 65536),
            44: struct.pack(">H", right % 65536),
        }[number]


class ArduinoSketch(LineEmulator):
    """The protocol of docs/arduino.md, written from its text."""

    COUNTS_PER_TURN, WHEEL_RADIUS = 1440, 0.033

    def switched_on(self) -> None:
        super().switched_on()
        self.wheels.set(0.0, 0.0)
        self.bumped, self.centimetres = 0, [200, -1, 15]
        self._last = self._reported = time.monotonic()

    def line(self, line: str) -> None:
        word, left, right = line.split()
        assert word == "D"
        self._last = time.monotonic()
        self.wheels.set(int(left) / 1000, int(right) / 1000)

    def idle(self) -> None:
        now = time.monotonic()
        if now - self._last > 0.3 and self.wheels.speeds != (0.0, 0.0):
            self.wheels.set(0.0, 0.0)
        if now - self._reported >= 0.05 and not self.stalled:
            self._reported = now
            turn = 2 * 3.141592653589793 * self.WHEEL_RADIUS
            left, right = (round(way / turn * self.COUNTS_PER_TURN) for way in self.wheels.way())
            numbers = [left, right, self.bumped, *self.centimetres]
            self.say(("S " + " ".join(map(str, numbers)) + "\n").encode())
