"""`mapweave find-port` and `find-cameras`: ports are pseudo-terminals, cameras are video files."""

import re
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.cli import main
from mapweave.doctor import camera, ports
from mapweave.exit_status import NO
from tests.agent.drivers.emulators import ArduinoSketch
from tests.mapweave.command_line import complaint
from tests.recordings import write_video
from tests.rtsp_stream import RtspStream


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second of images is enough here."""
    monkeypatch.setattr(camera, "SECONDS", 1.0)


@pytest.fixture
def plugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, ArduinoSketch]]:
    """A folder of devices with a robot and another adapter, which has a stable path."""
    (tmp_path / "line").mkdir()
    devices = tmp_path / "dev"
    (devices / "serial" / "by-id").mkdir(parents=True)
    sketch = ArduinoSketch(tmp_path / "line")
    (devices / "ttyUSB0").symlink_to(sketch.path)
    (devices / "ttyACM3").write_text("")
    (devices / "serial" / "by-id" / "usb-GPS-if00").symlink_to(devices / "ttyACM3")
    monkeypatch.setattr(ports.serial_ports, "__defaults__", (devices,))
    yield devices, sketch
    sketch.close()


def test_ports_are_listed(plugged: tuple[Path, ArduinoSketch], capsys):
    devices, _ = plugged
    assert main(["find-port"]) == 0
    gps, robot = capsys.readouterr().out.splitlines()
    assert gps == f"{devices}/ttyACM3  always at {devices}/serial/by-id/usb-GPS-if00"
    assert robot == f"{devices}/ttyUSB0"


def test_a_cable_may_be_pulled_while_ports_are_listed(plugged, monkeypatch):
    devices, sketch = plugged
    readlink = ports.os.readlink

    def pulled(path, **more):
        """Python looks whether it is a link, and then where it leads."""
        if str(path) == str(sketch.path):
            sketch.unplug()
        return readlink(path, **more)

    monkeypatch.setattr(ports.os, "readlink", pulled)
    assert [port.path for port in ports.serial_ports(devices)] == [f"{devices}/ttyACM3", f"{devices}/ttyUSB0"]
    assert [port.path for port in ports.serial_ports(devices)] == [f"{devices}/ttyACM3"]


def test_the_port_whose_cable_is_pulled_is_named(plugged, monkeypatch):
    devices, sketch = plugged
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    asked = threading.Event()

    def pull() -> None:
        asked.wait(10.0)
        sketch.unplug()

    class Terminal:
        """Tells when the person has been asked."""

        def write(self, words: str) -> int:
            if "Unplug" in words:
                asked.set()
            return len(words)

        def flush(self) -> None:
            pass

    thread = threading.Thread(target=pull)
    thread.start()
    out = sys.stdout
    said: list[str] = []

    def write(words: str) -> int:
        said.append(words)
        return Terminal.write(terminal, words)

    terminal = Terminal()
    terminal.write = write  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdout", terminal)
    try:
        assert main(["find-port", "--timeout", "20"]) == 0
    finally:
        monkeypatch.setattr(sys, "stdout", out)
        thread.join()
    assert f"it was {devices}/ttyUSB0: plug it in" in "".join(said)


def test_no_port_and_no_pull_are_one_line(plugged, monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    assert main(["find-port", "--timeout", "0.05"]) == NO
    assert "no port has gone" in capfd.readouterr().err
    monkeypatch.setattr(ports.serial_ports, "__defaults__", (tmp_path / "nothing",))
    assert "no serial port" in complaint(capfd, "find-port", status=NO)


def video(path: Path, size: tuple[int, int], level: int) -> Path:
    pattern = np.random.default_rng(1).integers(0, 256, (12, 16), np.uint8)
    image = (
        cv2.resize(pattern, size, interpolation=cv2.INTER_NEAREST)
        if level
        else np.zeros(size[::-1], np.uint8)
    )
    return write_video(path, [image] * 70, 25.0)


def test_a_frame_of_each_camera_is_saved(tmp_path, capfd):
    good = video(tmp_path / "good.avi", (320, 240), 1)
    dark = video(tmp_path / "dark.avi", (160, 120), 0)
    broken = tmp_path / "broken.avi"
    broken.write_bytes(b"no video")
    out = tmp_path / "frames"
    assert main(["find-cameras", str(good), str(dark), str(broken), "--out", str(out)]) == 0
    lines = capfd.readouterr().out.splitlines()
    sound = re.fullmatch(rf"{good}: 320x240 px, (\d+) images/s, frame in {out}/camera\d+.png", lines[0])
    assert sound is not None and 20 <= int(sound[1]) <= 26
    assert lines[1].startswith(f"{dark}: 160x120 px") and "the image is dark" in lines[1]
    assert lines[2].startswith(f"camera {broken}: cannot be opened; it is no video")
    frames = sorted(out.glob("*.png"))
    assert [cv2.imread(str(frame), 0).shape for frame in frames] == [(240, 320), (120, 160)]


def test_no_camera_is_an_error(tmp_path, capfd):
    words = complaint(capfd, "find-cameras", tmp_path / "none.avi", "--out", tmp_path / "frames", status=NO)
    assert "no such file" in words and "no camera gives an image" in words
    assert not (tmp_path / "frames").exists()


def test_a_password_in_an_address_is_not_shown(tmp_path, capfd, opened):
    frame = cv2.imencode(".jpg", np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8))[
        1
    ].tobytes()

    def next_frame() -> bytes:
        time.sleep(0.05)
        return frame

    place = opened(RtspStream(next_frame, "bob:secret")).place
    url, out = f"rtsp://bob:secret@{place}/cam", tmp_path / "frames"
    assert main(["find-cameras", url, "--json", "--out", str(out)]) == 0
    said = "".join(capfd.readouterr())
    assert f"rtsp://bob:***@{place}/cam" in said
    assert "secret" not in said
