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
