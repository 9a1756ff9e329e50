"""An agent that starts before its network camera: it waits where that can help, else it ends with a line."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.agent.drivers import camera as camera_module
from mapweave.cli import main
from mapweave.processes import stream_wait
from tests.mjpeg_stream import MjpegStream
from tests.rtsp_stream import RtspStream
from tests.waiting import free_port

DRIVER = """
import time
import numpy as np
from mapweave.agent.drivers.camera import Capture
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera

class Watching:
    # A robot that ends with its first image.
    def __init__(self, settings):
        self.camera, self.stamp_ns = Capture(settings.camera), 0

    def describe(self):
        return RobotDescription(camera=Camera(64, 48, 60.0, 60.0, 31.5, 23.5, mount_height=0.2))

    def sense(self):
        if self.stamp_ns:
            return None
        frame = self.camera.newer(0, 10.0)
        self.stamp_ns = frame.stamp_ns
        return Observation(frame.stamp_ns, Odometry(0.0, 0.0), frame.image)

    def act(self, command):
        return command

    def close(self):
        self.camera.close()
"""
SETTINGS = """
[robot.camera]
source = "{source}"
width = 64
height = 48
fx = 60.0
fy = 60.0
cx = 31.5
cy = 23.5
height_m = 0.2
"""
JPEG = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()


def frame() -> bytes:
    time.sleep(0.05)
    return JPEG


@pytest.fixture
def run(tmp_path: Path, monkeypatch) -> Callable[[str, str, Callable[[], object]], int]:
    """Runs `agent` or `record` with a camera; what is given is called before it asks again for the stream."""
    monkeypatch.setattr(camera_module, "STREAM_PATIENCE", 0.0)
    monkeypatch.setattr(stream_wait, "EVERY", 0.01)
    asked = stream_wait.refusal

    def status(by: str, source: str, meanwhile: Callable[[], object]) -> int:
        todo = [meanwhile]

        def ask(url: str) -> object:
            while todo:
                todo.pop()()
            return asked(url)

        monkeypatch.setattr(stream_wait, "refusal", ask)
        (tmp_path / "watching.py").write_text(DRIVER)
        settings = tmp_path / "r0.toml"
        settings.write_text(SETTINGS.format(source=source))
        rest = ["--robot", f"{tmp_path / 'watching.py'}:Watching", "--settings", str(settings)]
        rest += ["--connect", "tcp/127.0.0.1:1"]
        if by == "record":
            return main(["record", "r0", "--out", str(tmp_path / "drive"), *rest])
        return main(["agent", "r0", "--data", str(tmp_path / "data"), "--epoch", "1", *rest])

    return status


@pytest.mark.parametrize(("by", "scheme"), [("agent", "rtsp"), ("record", "http")])
def test_a_stream_that_is_there_later_is_waited_for(by: str, scheme: str, run, opened, capfd):
    """Both ended at once, and a robot whose camera boots as long as itself did not start."""
    port = free_port()

    def switch_on() -> None:
        opened(RtspStream(frame, port=port) if scheme == "rtsp" else MjpegStream(frame, port=port))

    path = "cam" if scheme == "rtsp" else "stream.mjpg"
    assert run(by, f"{scheme}://127.0.0.1:{port}/{path}", switch_on) == 0
    said = capfd.readouterr().err
    assert said.count("r0: waits for its stream: camera ") == 1
    assert f"no server listens at 127.0.0.1:{port}" in said and "r0: the stream is there, after " in said


def test_a_refusal_that_waiting_cannot_mend_ends_the_wait(run, opened, capfd):
    port = free_port()
    source = f"rtsp://bob:wrong@127.0.0.1:{port}/cam"
    assert run("record", source, lambda: opened(RtspStream(frame, "bob:secret", port))) == 1
    said = capfd.readouterr().err
    assert said.count("waits for its stream") == 1 and "wrong@" not in said
    assert said.splitlines()[-1].endswith("refuses this user name and password")


@pytest.mark.parametrize("by", ["agent", "record"])
def test_an_interrupt_ends_the_wait(by: str, run, capfd):
    source = f"rtsp://127.0.0.1:{free_port()}/cam"
    assert run(by, source, lambda: os.kill(os.getpid(), signal.SIGINT)) == 1
    said = capfd.readouterr().err
    assert said.count("waits for its stream") == 1
    assert said.splitlines()[-1].startswith(f"mapweave: camera {source}: cannot be opened")


@pytest.mark.parametrize("source", ["/nowhere/film.avi", "63"])
def test_a_device_or_file_that_is_not_there_is_not_waited_for(source: str, run, capfd):
    assert run("record", source, lambda: pytest.fail("it waits")) == 1
    assert "waits for its stream" not in capfd.readouterr().err
