"""Videos whose headers or chunks are damaged: refused, or read as far as they go."""

import cv2
import numpy as np
import pytest

from mapweave.agent.recordings.video import ASSUMED_RATE, video_images
from mapweave.hybridmap.errors import DeviceError


class Damaged:
    """A video whose damage OpenCV shows by times that are no numbers, or by an exception."""

    def __init__(self, stamp: float, rate: float, fails_at: int = 9) -> None:
        self._stamp, self._rate, self._fails_at, self._at = stamp, rate, fails_at, 0

    def grab(self) -> bool:
        self._at += 1
        if self._at == self._fails_at:
            raise cv2.error("chunk.m_size <= 67108864")
        return self._at <= 3

    def read(self) -> tuple[bool, object]:
        return self.grab(), np.zeros((48, 64), np.uint8)

    def get(self, what: int) -> float:
        return {cv2.CAP_PROP_POS_MSEC: self._stamp, cv2.CAP_PROP_FPS: self._rate}.get(what, 0.0)


@pytest.mark.parametrize("rate", [float("nan"), float("inf"), 1e-300, 0.0])
@pytest.mark.parametrize("stamp", [float("nan"), float("inf"), 1e300])
def test_times_that_are_no_numbers_are_none(stamp: float, rate: float, tmp_path, monkeypatch):
    (tmp_path / "a.avi").write_bytes(bytes(100))
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Damaged(stamp, rate))
    images = video_images(tmp_path / "a.avi")
    assert images.stamps_ns.tolist() == [round(1e9 * k / ASSUMED_RATE) for k in range(3)]
    assert "assumed" in images.assumed


def test_an_error_of_opencv_ends_the_video(tmp_path, monkeypatch):
    (tmp_path / "a.avi").write_bytes(bytes(100))
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Damaged(0.0, 10.0, fails_at=3))
    images = video_images(tmp_path / "a.avi")
    assert len(images.stamps_ns) == 2
    with pytest.raises(DeviceError, match="frame 2 cannot be decoded"):
        images.read(2)


class Streamed:
    """Ten frames a second of a stream, whose clock had run for 5 s; its header says how long it is from 0."""

    def __init__(self, frames: int) -> None:
        self._left, self._at = frames, -1

    def grab(self) -> bool:
        self._left, self._at = self._left - 1, self._at + 1
        return self._left >= 0

    def get(self, what: int) -> float:
        return {
            cv2.CAP_PROP_POS_MSEC: 100.0 * self._at,
            cv2.CAP_PROP_PTS: 50.0 + self._at,
            cv2.CAP_PROP_FPS: 10.0,
            cv2.CAP_PROP_FRAME_COUNT: 80.0,
        }.get(what, 0.0)


@pytest.mark.parametrize(
    ("frames", "says"), [(30, ""), (15, "cut off after 15 frames, 1.4 s: its header says 3.0 s")]
)
def test_a_video_whose_clock_does_not_begin_at_zero_is_whole(frames: int, says: str, tmp_path, monkeypatch):
    """As recorders of streams write Matroska: it was taken for one that is cut off."""
    (tmp_path / "a.mkv").write_bytes(bytes(100))
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Streamed(frames))
    images = video_images(tmp_path / "a.mkv")
    assert images.damage.endswith(says) and bool(images.damage) == bool(says)
    assert images.stamps_ns[0] == 0 and len(images.stamps_ns) == frames
