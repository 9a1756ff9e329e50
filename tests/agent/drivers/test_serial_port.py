"""Errors of a serial port are DeviceErrors of one line, whichever call meets them first."""

import os
import pty
import tty
from collections.abc import Callable, Iterator

import pytest

from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.hybridmap.errors import DeviceError


@pytest.fixture
def ends() -> Iterator[tuple[int, SerialPort]]:
    """The robot's end and the driver's end of a line."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = SerialPort(os.ttyname(slave), 115200)
    os.close(slave)
    yield master, port
    port.close()
    os.close(master)


@pytest.mark.parametrize("call", [
    lambda port: port.clear(),
    lambda port: port.write(b"x"),
    lambda port: port.read(1),
    lambda port: port.line(),
    lambda port: port.line_waiting(),
])  # fmt: skip
def test_a_port_that_vanishes_is_a_device_error(call: Callable[[SerialPort], object], opened):
    master, slave = pty.openpty()
    port = opened(SerialPort(os.ttyname(slave), 115200))
    os.close(slave)
    os.close(master)
    with pytest.raises(DeviceError, match=r"^/dev/pts/\d+: the port is gone$"):
        call(port)


def test_lines_end_by_either_character_and_empty_ones_are_skipped(ends: tuple[int, SerialPort]):
    master, port = ends
    os.write(master, b"\r\none\r\n\n\r two\rthr")
    assert [port.line(), port.line()] == ["one", "two"]
    assert not port.line_waiting()
    os.write(master, b"ee\n")
    assert port.line() == "three"
    with pytest.raises(DeviceError, match=r"no answer for 0\.3 s"):
        port.line()


@pytest.mark.parametrize(
    "read", [lambda port: port.line(), lambda port: port.read(50)], ids=["line", "bytes"]
)
def test_bytes_that_are_no_answer_ask_for_the_baud_rate(
    ends: tuple[int, SerialPort], read: Callable[[SerialPort], object]
):
    """A wrong baud rate, or a mouse at the port, is no robot that is switched off."""
    master, port = ends
    os.write(master, bytes(range(128, 140)))
    with pytest.raises(
        DeviceError, match=r"12 bytes came, and no whole answer .* and 115200 its baud rate\?$"
    ):
        read(port)


def test_a_port_is_opened_once(ends: tuple[int, SerialPort]):
    with pytest.raises(DeviceError, match="is in use by another process"):
        SerialPort(ends[1].path, 115200)


def test_a_port_that_is_not_there(tmp_path):
    with pytest.raises(DeviceError, match="there is no such port"):
        SerialPort(str(tmp_path / "ttyUSB7"), 115200)
    with pytest.raises(DeviceError, match=f"^{tmp_path}: "):
        SerialPort(str(tmp_path), 115200)
    for none in (str(tmp_path), "/dev/null"):
        with pytest.raises(DeviceError, match=f"^{none}: is no serial port$"):
            SerialPort(none, 115200)
