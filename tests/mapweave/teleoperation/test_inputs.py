"""Keys and sticks: bytes as terminals and the kernel send them, to shares of the robot's speeds."""

import fcntl
import os
import select
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import DeviceError
from mapweave.teleoperation.gamepad import Gamepad
from mapweave.teleoperation.keyboard import Keyboard


@pytest.mark.parametrize(("keys", "wanted"), [
    (b"w", (0.5, 0.0)), (b"\x1b[A", (0.5, 0.0)), (b"\x1bOB", (-0.5, 0.0)), (b"S", (-0.5, 0.0)),
    (b"\x1b[D", (0.0, 0.5)), (b"d", (0.0, -0.5)), (b"wa", (0.5, 0.5)), (b"w ", (0.0, 0.0)),
    (b"w++", (0.7, 0.0)), (b"w" + b"-" * 9, (0.1, 0.0)), (b"x\x1bw", (0.5, 0.0)),
])  # fmt: skip
def test_keys_drive(keys: bytes, wanted: tuple[float, float]):
    keyboard = Keyboard(0.5)
    keyboard.feed(keys, 10.0)
    assert keyboard.wanted(10.1) == pytest.approx(wanted)
    assert keyboard.wanted(10.5) == pytest.approx(wanted), "until the key repeats"
    assert keyboard.wanted(10.7) == (0.0, 0.0), "let go"
    assert not keyboard.quit


@given(st.lists(st.sampled_from([b"w", b"a", b"\x1b[A", b"\x1b[C", b"\x1bOD", b" ", b"s"])), st.data())
def test_sequences_may_come_in_pieces(keys: list[bytes], data: st.DataObject):
    whole, pieces, stream = Keyboard(0.5), Keyboard(0.5), b"".join(keys)
    whole.feed(stream, 1.0)
    cut = data.draw(st.integers(0, len(stream)))
    pieces.feed(stream[:cut], 1.0)
    pieces.feed(stream[cut:], 1.0)
    assert pieces.wanted(1.1) == whole.wanted(1.1)


@pytest.mark.parametrize("key", [b"q", b"Q", b"\x04"])
def test_a_key_ends_it(key: bytes):
    keyboard = Keyboard(0.5)
    keyboard.feed(key, 1.0)
    assert keyboard.quit


def event(value: int, kind: int, number: int) -> bytes:
    """`struct js_event` of the kernel: u32 time, s16 value, u8 type, u8 number; little-endian."""
    return (123456).to_bytes(4, "little") + value.to_bytes(2, "little", signed=True) + bytes([kind, number])


def test_the_left_stick_drives_and_a_button_stops(tmp_path, opened):
    device = tmp_path / "js0"
    os.mkfifo(device)
    pad = opened(Gamepad(device, 0.8))
    with device.open("wb", buffering=0) as kernel:
        # The state at the opening: type 0x80 | axis, 0x80 | button.
        kernel.write(b"".join(event(0, 0x82, axis) for axis in range(6)) + event(0, 0x81, 0))
        pad.read()
        assert pad.wanted() == (0.0, 0.0)
        kernel.write(event(-32767, 0x02, 1) + event(16384, 0x02, 0) + event(32767, 0x02, 4))
        pad.read()
        assert pad.wanted() == pytest.approx((0.8, -0.4), abs=1e-3)
        kernel.write(event(1, 0x01, 5))
        pad.read()
        assert pad.wanted() == (0.0, 0.0)
        half = event(0, 0x01, 5)
        kernel.write(half[:3])
        pad.read()
        assert pad.wanted() == (0.0, 0.0)
        kernel.write(half[3:] + event(-32768, 0x02, 1) + event(2000, 0x02, 0))
        pad.read()
        assert pad.wanted() == pytest.approx((0.8, 0.0)), "a stick that rests beside its middle does not turn"
        pad.read()
    with pytest.raises(DeviceError, match="gone"):
        pad.read()


def test_a_gamepad_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DeviceError, match=r"gamepad .*js7: No such file"):
        Gamepad(tmp_path / "js7", 0.5)


@pytest.mark.parametrize("other", ["/dev/null", __file__])
def test_a_file_that_is_no_joystick_is_named(other: str):
    """The bytes of an event device were read as a joystick's: the robot stood, and nothing said why."""
    with pytest.raises(
        DeviceError, match=r"is no joystick device \(an event device is none\); give its device"
    ):
        Gamepad(Path(other), 0.5)


@pytest.fixture
def plugged(tmp_path, opened):
    """A gamepad with its kernel's side."""
    device = tmp_path / "js0"
    os.mkfifo(device)
    pad = opened(Gamepad(device, 1.0))
    return pad, opened(device.open("wb", buffering=0))


@pytest.mark.parametrize("axes", [2, 8, 16])
def test_axes_beyond_the_left_stick_do_not_drive(axes: int, plugged):
    pad, kernel = plugged
    # Triggers rest at one end.
    kernel.write(b"".join(event(0 if axis < 2 else -32767, 0x82, axis) for axis in range(axes)))
    kernel.write(b"".join(event(32767, 0x02, axis) for axis in range(2, axes)) + event(-16384, 0x02, 1))
    pad.read()
    assert pad.wanted() == pytest.approx((0.5, 0.0), abs=1e-3)


@pytest.mark.parametrize("at", [-32767, 32767, 5000])
def test_a_stick_that_is_not_in_the_middle_at_the_start_drives_nothing(at: int, plugged):
    """The robot drove as the command was given. Some pads read as an end until they have been touched."""
    pad, kernel = plugged
    kernel.write(event(at, 0x82, 1) + event(0, 0x82, 0) + event(0, 0x81, 0))
    pad.read()
    assert pad.wanted() == (0.0, 0.0)
    assert f"let go of the left stick, it is at {at / 32767:+.0%}" in pad.hint
    kernel.write(event(20000, 0x02, 0))
    pad.read()
    assert pad.wanted() == (0.0, 0.0)
    kernel.write(event(200, 0x02, 1) + event(0, 0x02, 0) + event(-32767, 0x02, 1))
    pad.read()
    assert pad.wanted() == (1.0, 0.0)
    assert "let go" not in pad.hint
    # The kernel repeats the state with the flag when its queue of 64 events was full.
    kernel.write(event(-30000, 0x82, 1))
    pad.read()
    assert pad.wanted() == pytest.approx((0.916, 0.0), abs=1e-3)


def test_after_a_burst_the_newest_state_holds(plugged):
    pad, kernel = plugged
    burst = b"".join(event(k % 32768, 0x02, 1) for k in range(9_998)) + event(-32767, 0x02, 1)
    writer = threading.Thread(target=kernel.write, args=(burst + event(0, 0x02, 0),))
    writer.start()
    while writer.is_alive() or select.select([pad], [], [], 0.0)[0]:
        pad.read()
    assert pad.wanted() == (1.0, 0.0)


@pytest.mark.parametrize("axes", [0, 1])
def test_a_device_without_a_stick_is_named(axes: int, tmp_path, monkeypatch):
    """A pad of buttons alone never drove, and nothing said why."""
    device = tmp_path / "js0"
    device.write_bytes(b"")

    def ioctl(fd: int, request: int, argument: bytes | bytearray) -> int:
        """JSIOCGVERSION gives 4 bytes, JSIOCGAXES one; the sizes are in the requests."""
        assert request in (0x80046A01, 0x80016A11) and len(argument) == request >> 16 & 0x3FFF
        if isinstance(argument, bytearray):
            argument[0] = axes
        return 0

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    with pytest.raises(DeviceError, match=rf"js0: has {axes} axes, and a stick has two; give its device"):
        Gamepad(device, 0.5)
