"""Keys and sticks: bytes as terminals and the kernel send them, to shares of the robot's speeds."""

import os
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
