"""Images from a video device, a file or a stream with OpenCV: the newest frame, stamped at capture.

For a Raspberry Pi's own camera see docs/robot.md.
"""

import logging
import os
import re
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.clock import now_ns, of_monotonic_ns
from mapweave.agent.drivers.settings import CameraSettings
from mapweave.agent.drivers.stream_refusal import refusal, without_password
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.image_file import check_size

log = logging.getLogger(__name__)

RETRY = 1.0
"""s between two attempts to open a camera."""
SETTLING = 1.0
"""s of automatic exposure before it is locked."""
STREAM_PATIENCE = 5.0
"""s in which a stream may come back: rpicam-vid ends with the program that it served, and starts again."""
STREAM_SILENT_MS = 5000.0
"""Without a byte of a stream after which its connection is given up; OpenCV waits 30 s."""
MOST_DAMAGED = 10
"""Images in a row that cannot be decoded before a stream is opened again, which takes a second."""
DAMAGED_PAUSE = 0.02
"""s between two of them: a stream that has ended says at once that it has no more."""
LONGEST_GAP = 0.5
"""s without an image, after which the first one is left out: FFmpeg's parser and decoders hand over the last
one from before the gap only then."""
FFMPEG_LEVEL, QUIET = "OPENCV_FFMPEG_LOGLEVEL", "-8"
"""FFmpeg writes up to thirty lines of its own about each damaged image."""
FFMPEG_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
"""The environment's variable that OpenCV reads when it opens a source."""
UNBUFFERED = "fflags;nobuffer|analyzeduration;500000"
"""By default FFmpeg examines the images of a stream for up to 5 s, keeps them, and delivers them first: each
would be as old as that, with the stamp of now."""
OVER_TCP = "|rtsp_flags;prefer_tcp"
"""For RTSP, as OpenCV sets it where no options are given."""
FARTHEST_STAMP_NS = 1_000_000_000
"""Largest age of a frame; a greater difference means that the device uses another clock."""


class NotOpened(DeviceError):
    """A source that does not open; what is wrong with a stream is for its server to say."""


class StreamAway(DeviceError):
    """A stream that does not open yet, and may later: its server is not reached, or not ready.

    Attributes:
        url: of the stream, with its password.
    """

    def __init__(self, words: str, url: str) -> None:
        super().__init__(words)
        self.url = url


class StampedImage(NamedTuple):
    """An image with its stamp.

    Attributes:
        stamp_ns: of the exposure.
        image: (H, W) uint8 grey.
    """

    stamp_ns: int
    image: NDArray[np.uint8]


class FrameSource(Protocol):
    """A camera."""

    def newer(self, stamp_ns: int, patience: float) -> StampedImage | None:
        """Wait up to `patience` (s) for a frame newer than a stamp; returns the newest. Never raises."""

    def close(self) -> None:
        """Release the camera. Never raises."""


class Capture:
    """OpenCV capture. A thread grabs every frame, so that buffers stay empty, and keeps the newest."""

    def __init__(self, settings: CameraSettings) -> None:
        """Open the source and start to capture.

        Raises:
            StreamAway: the stream does not answer yet.
            DeviceError: the source cannot be opened.
        """
        self._settings = settings
        self._name = without_password(settings.source)
        self._waited = 0.0
        self._changed = threading.Condition()
        self._newest: StampedImage | None = None
        self._closing = False
        self._capture = self._open_in_time()
        self._thread = threading.Thread(target=self._serve, name="camera", daemon=True)
        self._thread.start()

    def newer(self, stamp_ns: int, patience: float) -> StampedImage | None:
        """Wait for a frame newer than a stamp; see FrameSource."""

        def there() -> bool:
            return self._closing or (self._newest is not None and self._newest.stamp_ns > stamp_ns)

        with self._changed:
            self._changed.wait_for(there, patience)
            return self._newest if self._newest is not None and self._newest.stamp_ns > stamp_ns else None

    def close(self) -> None:
        """Release the source. May be called twice."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(2.0)

    def _open_in_time(self) -> cv2.VideoCapture:
        source, why = self._settings.source, f"camera {self._name}: cannot be opened; "
        if "://" not in source:
            try:
                return self._open()
            except NotOpened:
                raise DeviceError(why + self._hint()) from None
        has_password, refused = self._name != source, None
        end = time.monotonic() + STREAM_PATIENCE
        while True:
            with suppress(NotOpened):
                return self._open()
            # Cameras lock a user out after some wrong passwords. Once more: the server may just have begun.
            if refused is not None and refused.login:
                break
            over = time.monotonic() >= end
            # The question to a server that serves one program after the other ends what it serves.
            if over or (has_password and (refused is None or refused.may_pass)):
                refused = refusal(source)
            if over:
                break
            time.sleep(RETRY / 5)
        assert refused is not None
        if refused.may_pass:
            raise StreamAway(why + refused.words, source)
        raise DeviceError(why + refused.words)

    def _open(self) -> cv2.VideoCapture:
        settings, source = self._settings, self._settings.source
        # OpenCV writes lines of its own about devices that are no cameras, beside the error here.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        os.environ.setdefault(FFMPEG_LEVEL, QUIET)
        number = re.fullmatch(r"(?:/dev/video)?(\d+)", source)
        self._is_device = number is not None
        self._is_file = number is None and "://" not in source
        if self._is_file and not Path(source).is_file():
            raise DeviceError(f"camera {self._name}: no such file; a source is a number, a file or a URL")
        if number is not None:
            capture = cv2.VideoCapture(int(number[1]), cv2.CAP_V4L2)
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        else:
            set_here = not self._is_file and FFMPEG_OPTIONS not in os.environ
            if set_here:
                rtsp = source.lower().startswith(("rtsp://", "rtsps://"))
                os.environ[FFMPEG_OPTIONS] = UNBUFFERED + (OVER_TCP if rtsp else "")
            # FFmpeg with n threads decodes n frames at once, which delays each by n frames.
            options = [
                cv2.CAP_PROP_N_THREADS, 1, cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(STREAM_SILENT_MS),
                cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(STREAM_SILENT_MS),
            ]  # fmt: skip
            capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)
            if set_here:
                del os.environ[FFMPEG_OPTIONS]
        if not capture.isOpened():
            capture.release()
            raise NotOpened(self._name)
        try:
            # Later frames of another size are scaled to the first one's.
            check_size(
                *(int(capture.get(of)) for of in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            )
        except InvalidValue as error:
            capture.release()
            raise DeviceError(f"camera {self._name}: {error}") from None
        return capture

    def _hint(self) -> str:
        """What may be wrong with a device or a file that does not open."""
        if self._is_file:
            return "it is no video, or one cut off at its start; `mapweave info` says what is in a file"
        return "is it connected, and not in use by another program?"

    # In the camera's thread.

    def _serve(self) -> None:
        reported: StampedImage | None = None
        said = False
        while not self._closing:
            reason = self._take_all()
            self._capture.release()
            if self._is_file or self._closing:
                return
            # A camera that opens and delivers nothing is reported once, not with each attempt.
            if not said or self._newest is not reported:
                log.warning("camera %s delivers no images%s; opening it again", self._name, reason)
                reported, said = self._newest, True
            while not self._closing:
                time.sleep(RETRY)
                try:
                    self._capture = self._open()
                    break
                except DeviceError:
                    continue

    def _take_all(self) -> str:
        """Capture until the source ends; returns why it did, if OpenCV says."""
        try:
            self._take_each()
        except cv2.error as error:
            return f" ({' '.join(str(error.err or error).split())})"
        return ""

    def _take_each(self) -> None:
        """Capture until the source ends.

        Raises:
            cv2.error: an image is in no format that can be used.
        """
        capture, settings = self._capture, self._settings
        begin, locked = time.monotonic(), not (settings.lock_exposure and self._is_device)
        while not self._closing and self._grabs(capture):
            if self._is_file:
                # A file plays at its frame rate.
                ahead = begin + capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3 - time.monotonic()
                time.sleep(max(ahead, 0.0))
            stamp_ns = self._stamp_ns() - round(settings.delay * 1e9)
            good, image = capture.retrieve()
            if not good or image is None:
                return
            grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            with self._changed:
                self._newest = StampedImage(stamp_ns, np.asarray(grey, dtype=np.uint8))
                self._changed.notify_all()
            if not locked and time.monotonic() - begin >= SETTLING:
                locked = True
                self._lock_exposure()

    def _grabs(self, capture: cv2.VideoCapture) -> bool:
        """Whether there is another image; those of a stream that are damaged or late are left out."""
        live = not (self._is_file or self._is_device)
        began = time.monotonic()
        for _ in range(MOST_DAMAGED):
            asked = time.monotonic()
            grabbed = capture.grab()
            now, waited_before = time.monotonic(), self._waited
            self._waited = now - asked
            if not live:
                return grabbed
            # One that comes as the connection is given up is as old as that.
            if self._closing or now - began >= STREAM_SILENT_MS / 1e3:
                break
            # A camera of one image in two seconds has a gap each time.
            if grabbed and not self._waited > LONGEST_GAP >= waited_before:
                return True
            if grabbed:
                began = now
            else:
                time.sleep(DAMAGED_PAUSE)
        return False

    def _stamp_ns(self) -> int:
        """Stamp of the frame that was just grabbed."""
        if self._is_device:
            # Video4Linux stamps frames with the monotonic clock; some device drivers do not.
            taken = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if 0 <= time.monotonic_ns() - taken < FARTHEST_STAMP_NS:
                return of_monotonic_ns(taken)
        return now_ns()

    def _lock_exposure(self) -> None:
        """Fix exposure and white balance at their present values."""
        capture = self._capture
        exposure = capture.get(cv2.CAP_PROP_EXPOSURE)
        # 1 is manual exposure in Video4Linux.
        done = capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1) and capture.set(cv2.CAP_PROP_EXPOSURE, exposure)
        capture.set(cv2.CAP_PROP_AUTO_WB, 0)
        if not done:
            log.warning("camera %s: this device cannot lock its exposure", self._name)
