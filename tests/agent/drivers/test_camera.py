"""OpenCV capture: the newest frame, stamped when it was taken."""

import os
import re
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.agent.drivers import camera as camera_module
from mapweave.agent.drivers import stream_refusal
from mapweave.agent.drivers.camera import Capture, StampedImage
from mapweave.agent.drivers.settings import CameraSettings
from mapweave.agent.drivers.stream_refusal import refusal, without_password
from mapweave.hybridmap.errors import DeviceError
from tests.mjpeg_stream import MjpegStream
from tests.recordings import write_video
from tests.rtsp_stream import RtspStream
from tests.waiting import eventually, free_port

WIDTH, HEIGHT = 64, 48
RATE = 20.0


def settings(source: str, **rest: float) -> CameraSettings:
    return CameraSettings(WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0, 0.3, source=source, **rest)  # type: ignore[arg-type]


def shade(number: int) -> int:
    """Frames count in grey."""
    return 5 * (number % 50)


@pytest.fixture
def clip(tmp_path: Path) -> str:
    """Frames that say their number."""
    frames = [np.full((HEIGHT, WIDTH), shade(k), np.uint8) for k in range(40)]
    return str(write_video(tmp_path / "clip.avi", frames, RATE))


def test_a_file_plays_at_its_own_pace_and_gives_its_newest_frame(clip: str, opened):
    camera = opened(Capture(settings(clip)))
    first = camera.newer(0, 2.0)
    assert first is not None
    assert first.image.shape == (HEIGHT, WIDTH)
    time.sleep(0.5)
    later = camera.newer(first.stamp_ns, 0.2)
    assert later is not None
    # The ten frames between are not waited for.
    passed = (later.stamp_ns - first.stamp_ns) / 1e9
    assert passed == pytest.approx(0.5, abs=0.12)
    assert (int(later.image[0, 0]) - int(first.image[0, 0])) / 5 == pytest.approx(passed * RATE, abs=2)
    assert abs(time.time_ns() - later.stamp_ns) < 0.3e9


def test_after_the_end_of_a_file_nothing_comes(clip: str):
    camera = Capture(settings(clip))
    time.sleep(2.5)
    last = camera.newer(0, 0.1)
    assert last is not None
    begin = time.monotonic()
    assert camera.newer(last.stamp_ns, 0.1) is None
    assert time.monotonic() - begin < 0.3
    camera.close()
    camera.close()


def test_a_known_delay_is_subtracted(clip: str, opened):
    camera = opened(Capture(settings(clip, delay=5.0)))
    frame = camera.newer(0, 2.0)
    assert frame is not None
    assert (time.time_ns() - frame.stamp_ns) / 1e9 == pytest.approx(5.0, abs=0.4)


@pytest.mark.parametrize(
    ("source", "words"),
    [("/nowhere/film.avi", "no such file"), ("63", "camera 63: cannot be opened; is it connected")],
)
def test_a_source_that_is_not_there(source: str, words: str):
    with pytest.raises(DeviceError, match=words):
        Capture(settings(source))


def test_of_a_stream_that_is_not_there_its_server_is_asked_for(monkeypatch):
    monkeypatch.setattr(camera_module, "STREAM_PATIENCE", 0.0)
    url = f"http://127.0.0.1:{free_port()}/video"
    with pytest.raises(
        DeviceError, match=r"cannot be opened; no server listens at 127\.0\.0\.1:\d+: start it"
    ):
        Capture(settings(url))


class Stream(MjpegStream):
    """Frames say when they were made."""

    def __init__(self) -> None:
        self.number = 0
        self.stop, self.silent, self.damaged = threading.Event(), threading.Event(), False
        super().__init__(self._frame)

    def _frame(self) -> bytes | None:
        if self.stop.wait(1 / RATE):
            return None
        self.number += 1
        if self.silent.is_set():
            self.stop.wait(20.0)
            return None
        if self.damaged and self.number % 5 == 0:
            return b"no image at all"
        return cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), shade(self.number), np.uint8))[1].tobytes()

    def close(self) -> None:
        self.stop.set()
        super().close()


@pytest.fixture
def stream(opened) -> Stream:
    return opened(Stream())


def test_a_stream_over_http_is_no_more_than_two_frames_behind(stream: Stream, opened):
    camera = opened(Capture(settings(stream.url)))
    behind = []
    frame = camera.newer(0, 5.0)
    for _ in range(10):
        assert frame is not None
        time.sleep(0.12)
        frame = camera.newer(frame.stamp_ns, 1.0)
        assert frame is not None
        behind.append((stream.number - round(int(frame.image[0, 0]) / 5)) % 50)
    assert np.median(behind) <= 2


class OneAtATime:
    """Frames on TCP that say their number, as of `rpicam-vid --listen` in a loop of the shell.

    That ends with each program that it has served, and is there again after a while.
    """

    AWAY = 0.5

    def __init__(self) -> None:
        self.number = 0
        self._scene = np.random.default_rng(1).integers(0, 255, (240, 320), np.uint8)
        self._closing = threading.Event()
        with socket.create_server(("127.0.0.1", 0)) as free:
            self._place = free.getsockname()
        self.url = f"tcp://127.0.0.1:{self._place[1]}"
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while not self._closing.is_set():
            client = None
            with socket.create_server(self._place) as listening:
                listening.settimeout(0.1)
                while client is None and not self._closing.is_set():
                    with suppress(TimeoutError):
                        client, _ = listening.accept()
            if client is not None:
                with client, suppress(OSError):
                    self._send(client)
                self._closing.wait(self.AWAY)

    def _send(self, client: socket.socket) -> None:
        client.settimeout(5.0)
        self.number = 0
        while not self._closing.wait(1 / RATE):
            self.number += 1
            self._scene[:40, :40] = self.number % 256
            client.sendall(cv2.imencode(".jpg", self._scene)[1].tobytes())

    def close(self) -> None:
        self._closing.set()
        self._thread.join()


@pytest.fixture
def raw_stream(opened) -> OneAtATime:
    return opened(OneAtATime())


def test_images_without_a_container_begin_with_that_of_now(raw_stream: OneAtATime, opened):
    """They were five seconds old, with the stamp of now."""
    camera = opened(Capture(settings(raw_stream.url)))
    frame = camera.newer(0, 5.0)
    assert frame is not None
    assert (raw_stream.number - int(frame.image[20, 20])) % 256 <= 3


def test_a_stream_that_serves_one_program_after_the_other_is_waited_for(raw_stream: OneAtATime):
    """As `mapweave doctor` opens the camera twice."""
    for _ in range(2):
        camera = Capture(settings(raw_stream.url))
        assert camera.newer(0, 5.0) is not None
        camera.close()


def test_a_stream_that_ends_is_opened_again(stream: Stream, opened):
    camera = opened(Capture(settings(stream.url)))
    frame = camera.newer(0, 5.0)
    assert frame is not None
    stop, stream.stop = stream.stop, threading.Event()
    stop.set()
    time.sleep(0.2)
    last = camera.newer(0, 0.1)
    assert last is not None
    assert camera.newer(last.stamp_ns, 6.0) is not None


def test_damaged_images_of_a_stream_are_left_out(stream: Stream, opened, caplog):
    """Each of them closed the connection for a second."""
    stream.damaged = True
    camera = opened(Capture(settings(stream.url)))
    frame = camera.newer(0, 5.0)
    gaps = []
    for _ in range(40):
        assert frame is not None
        before = frame.stamp_ns
        frame = camera.newer(before, 5.0)
        assert frame is not None
        gaps.append((frame.stamp_ns - before) / 1e9)
    assert max(gaps) < 0.9 and not caplog.messages


def test_a_stream_that_falls_silent_is_given_up(stream: Stream, opened, monkeypatch, caplog):
    """A server that is switched off says nothing: the connection was held for 30 s."""
    monkeypatch.setattr(camera_module, "STREAM_SILENT_MS", 500.0)
    camera = opened(Capture(settings(stream.url)))
    assert camera.newer(0, 5.0) is not None
    stream.silent.set()
    eventually(lambda: any("delivers no images; opening it again" in line for line in caplog.messages), 10.0)
    stream.silent.clear()
    last = camera.newer(0, 0.1)
    assert last is not None and camera.newer(last.stamp_ns, 6.0) is not None


class Device:
    """What OpenCV makes of a Video4Linux device, for machines without one."""

    def __init__(self, locks: bool) -> None:
        self.locks = locks
        self.properties = {cv2.CAP_PROP_EXPOSURE: 157.0, cv2.CAP_PROP_AUTO_EXPOSURE: 3.0}
        self.exposed_ns = 0
        self.released = False

    def isOpened(self) -> bool:
        return True

    def set(self, name: int, value: float) -> bool:
        if name == cv2.CAP_PROP_AUTO_EXPOSURE and not self.locks:
            return False
        self.properties[name] = value
        return True

    def get(self, name: int) -> float:
        if name == cv2.CAP_PROP_POS_MSEC:
            return self.exposed_ns / 1e6
        return self.properties.get(name, 0.0)

    def grab(self) -> bool:
        # Taken 60 ms before it is here.
        self.exposed_ns = time.monotonic_ns() - 60_000_000
        time.sleep(0.03)
        return not self.released

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((HEIGHT, WIDTH, 3), np.uint8)

    def release(self) -> None:
        self.released = True


class Unusable(Device):
    """It opens each time, and its images are in another format."""

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((HEIGHT, WIDTH, 2), np.uint8)


def test_a_device_with_images_of_another_format_is_reported_once(monkeypatch, caplog):
    """Before, its thread ended with a traceback, and a camera without images was logged each second."""
    opened: list[object] = []
    monkeypatch.setattr("cv2.VideoCapture", lambda *arguments: opened.append(arguments) or Unusable(True))
    monkeypatch.setattr("mapweave.agent.drivers.camera.RETRY", 0.05)
    camera = Capture(settings("/dev/video2"))
    eventually(lambda: len(opened) >= 4)
    camera.close()
    (line,) = caplog.messages
    assert line.startswith("camera /dev/video2 delivers no images (") and line.endswith("; opening it again")


def test_a_source_of_too_many_pixels_is_refused_before_a_frame_is_decoded(clip: str, monkeypatch):
    device = Device(True)
    device.properties |= {cv2.CAP_PROP_FRAME_WIDTH: 16_000.0, cv2.CAP_PROP_FRAME_HEIGHT: 16_000.0}
    monkeypatch.setattr("cv2.VideoCapture", lambda *_: device)
    monkeypatch.setattr(Device, "grab", lambda _: pytest.fail("it was decoded"))
    with pytest.raises(DeviceError, match=r"clip.*: an image of 16000x16000 px is too large: at most"):
        Capture(settings(clip))
    assert device.released


@pytest.mark.parametrize("locks", [True, False])
def test_a_device_is_stamped_by_its_driver_and_its_exposure_locked(locks: bool, monkeypatch, caplog):
    device, opened = Device(locks), []
    monkeypatch.setattr("cv2.VideoCapture", lambda *arguments: opened.append(arguments) or device)
    monkeypatch.setattr("mapweave.agent.drivers.camera.SETTLING", 0.2)
    camera = Capture(settings("/dev/video2", lock_exposure=True))
    assert opened == [(2, cv2.CAP_V4L2)]
    frame = camera.newer(0, 2.0)
    assert frame is not None
    age = (time.time_ns() - frame.stamp_ns) / 1e9
    assert 0.08 < age < 0.4
    assert device.properties[cv2.CAP_PROP_FRAME_WIDTH] == WIDTH
    assert device.properties[cv2.CAP_PROP_AUTO_EXPOSURE] == 3.0
    time.sleep(0.6)
    assert device.properties[cv2.CAP_PROP_AUTO_EXPOSURE] == (1.0 if locks else 3.0)
    assert device.properties[cv2.CAP_PROP_EXPOSURE] == 157.0
    assert ("cannot lock its exposure" in caplog.text) is not locks
    camera.close()
    assert device.released


class Counted:
    """Frames that say their number, at a steady rate."""

    def __init__(self) -> None:
        self.number = 0
        self._began = time.monotonic()

    def next(self) -> bytes:
        self.number += 1
        time.sleep(max(self._began + self.number / RATE - time.monotonic(), 0.0))
        image = np.full((HEIGHT, WIDTH, 3), shade(self.number), np.uint8)
        return cv2.imencode(".jpg", image)[1].tobytes()


def test_an_rtsp_stream_begins_with_the_image_of_now(opened, monkeypatch):
    """Its first images were up to 1.4 s old, with the stamp of now."""
    frames, behind = Counted(), []

    def stamped(stamp_ns: int, image: np.ndarray) -> StampedImage:
        behind.append((frames.number - round(int(image[20, 20]) / 5)) % 50)
        return StampedImage(stamp_ns, image)

    monkeypatch.setattr(camera_module, "StampedImage", stamped)
    camera = opened(Capture(settings(opened(RtspStream(frames.next)).url)))
    frame = camera.newer(0, 5.0)
    assert frame is not None
    assert frame.image.shape == (HEIGHT, WIDTH)
    assert behind[0] <= 3


@pytest.mark.parametrize("scheme", ["RTSP", "http", "udp"])
def test_no_stream_is_buffered_unless_options_are_given(scheme: str, monkeypatch):
    """MPEG-TS over HTTP began with the images of two seconds."""
    given: list[str | None] = []

    def opened(*_: object) -> Paused:
        given.append(os.environ.get(camera_module.FFMPEG_OPTIONS))
        return Paused([])

    monkeypatch.setattr("cv2.VideoCapture", opened)
    Capture(settings(f"{scheme}://camera/stream")).close()
    monkeypatch.setenv(camera_module.FFMPEG_OPTIONS, "rtsp_transport;udp")
    Capture(settings(f"{scheme}://camera/stream")).close()
    unbuffered = "fflags;nobuffer|analyzeduration;500000"
    over_tcp = "|rtsp_flags;prefer_tcp" if scheme == "RTSP" else ""
    assert given == [unbuffered + over_tcp, "rtsp_transport;udp"]


@pytest.mark.parametrize(
    ("credentials", "path", "words"),
    [
        ("bob:", "cam", "asks for a user name and a password: rtsp://USER:PASSWORD@"),
        ("", "other", "has nothing at /other: mend the path"),
        ("bob:wr%3Fong", "cam", "refuses this user name and password"),
    ],
)
def test_why_a_stream_does_not_open_is_said_without_its_password(
    credentials: str, path: str, words: str, opened, monkeypatch
):
    """All of them were "cannot be opened; does its server run", with the password in the line."""
    monkeypatch.setattr(camera_module, "STREAM_PATIENCE", 0.0)
    asked = "bob:secret" if credentials else ""
    place = opened(RtspStream(Counted().next, asked)).place
    who = "" if credentials in ("", "bob:") else f"{credentials}@"
    with pytest.raises(DeviceError) as refused:
        Capture(settings(f"rtsp://{who}{place}/{path}"))
    line = str(refused.value)
    assert words in line and "ong" not in line and "\n" not in line
    assert line.startswith(
        f"camera rtsp://{'bob:***@' if who else ''}{place}/{path}: cannot be opened; {place}"
    )


def test_a_wrong_password_is_not_tried_again_and_again(opened):
    """It was 27 times within 5 s; network cameras lock a user out after a few."""
    stream = opened(RtspStream(Counted().next, "bob:secret"))
    with pytest.raises(DeviceError, match="refuses this user name and password"):
        Capture(settings(f"rtsp://bob:wrong@{stream.place}/cam"))
    assert 1 <= stream.wrong_logins <= 3


def test_a_stream_with_the_right_password_opens(opened):
    place = opened(RtspStream(Counted().next, "bob:wr?ong")).place
    camera = opened(Capture(settings(f"rtsp://bob:wr%3Fong@{place}/cam")))
    assert camera.newer(0, 5.0) is not None


def test_a_server_that_hangs_or_speaks_another_protocol_is_named(stream: Stream, monkeypatch):
    monkeypatch.setattr(stream_refusal, "PATIENCE", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        place = "{}:{}".format(*silent.getsockname())
        words = f"{place} does not answer: is that computer on, and does its server hang?"
        assert refusal(f"rtsp://{place}/cam") == (words, True, False)
    words = f"no server listens at {place}: start it, or mend the port"
    assert refusal(f"rtsp://{place}/cam") == (words, True, False)
    other = refusal(stream.url.replace("http", "rtsp"))
    assert re.fullmatch(r"127.*:\d+ answers 505 .*|what listens at .* does not speak RTSP", other.words)
    assert not other.may_pass
    assert refusal(stream.url) == ("does a player show images of this address?", False, False)
    assert refusal("tcp://camera") == ("is its address complete, with the port?", False, False)
    # Nothing listens by TCP where a camera sends by UDP.
    assert refusal(f"udp://{place}") == ("does a player show images of this address?", False, False)
    assert refusal("rtsp://[::1/cam") == ("its address is no URL", False, False)
    assert without_password("rtsp://u:p@ss@h:1/a@b:c") == "rtsp://u:***@h:1/a@b:c"
    for plain in ("/dev/video0", "rtsp://h:554/x", "rtsp://u@h/x", "C:/a@b"):
        assert without_password(plain) == plain


class Paused(Device):
    """A stream whose images come after these times, and say which they are."""

    def __init__(self, waits: list[float]) -> None:
        super().__init__(False)
        self.waits, self.number = waits, 0

    def grab(self) -> bool:
        if self.number == len(self.waits):
            time.sleep(0.05)
            return False
        self.number += 1
        time.sleep(self.waits[self.number - 1])
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((HEIGHT, WIDTH), self.number, np.uint8)


@pytest.mark.parametrize(
    ("waits", "wanted"),
    [
        ([0.02, 0.02, 0.3, 0.02, 0.02], [1, 2, 4, 5]),
        ([0.02, 0.3, 0.3, 0.3], [1, 3, 4]),
        ([0.02, 0.02, 0.6, 0.02], [1, 2]),
    ],
    ids=["after a gap", "a slow camera", "as it is given up"],
)
def test_the_image_from_before_a_gap_gets_no_stamp_of_now(waits: list[float], wanted: list[int], monkeypatch):
    """A stream of H.264 hands it over when the next one comes: it was two seconds old after two seconds."""
    monkeypatch.setattr(camera_module, "LONGEST_GAP", 0.15)
    monkeypatch.setattr(camera_module, "STREAM_SILENT_MS", 500.0)
    monkeypatch.setattr(camera_module, "RETRY", 0.1)
    monkeypatch.setattr("cv2.VideoCapture", lambda *_: sources.pop() if sources else Paused([]))
    sources = [Paused(waits)]
    seen: list[int] = []
    camera = Capture(settings("rtsp://camera/stream"))
    last = 0
    # What would come late comes at once, or as the connection is given up.
    while (frame := camera.newer(last, 0.7)) is not None:
        last = frame.stamp_ns
        seen.append(int(frame.image[0, 0]))
    camera.close()
    assert seen == wanted
