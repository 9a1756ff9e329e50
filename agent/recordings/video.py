"""A plain video file, with odometry in a file of its own."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.incomplete import complete
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.recordings.pose_files import read_poses
from mapweave.agent.recordings.recording import Images, Recording
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.hybridmap.limits import MAX_STAMP_NS
from mapweave.storage.image_file import check_size

RAW = {".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg", ".mjpg"}
"""Streams in no container, as cameras of a Raspberry Pi are recorded: they have no times."""
SUFFIXES = {
    ".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".3gp", ".wmv",
    ".asf", ".flv", ".ogv", *RAW,
}  # fmt: skip

INDEXED = {".mp4", ".mov", ".m4v"}
"""Their index stands at the end."""
ASSUMED_RATE = 30.0
"""Images a second where neither frames nor header say."""
OTHER_TRACK = 1.0
"""An AVI says how many frames it has; others how long they are, to which sound may add this, s."""

PTS = 71
"""`cv2.CAP_PROP_PTS`, in frames; OpenCV 4.10 does not know it and says 0."""


def video(path: Path, options: RecordingOptions) -> Recording:
    """Open a video. Stamps begin at 0 with the first frame.

    Raises:
        DeviceError: it cannot be read, or its camera or odometry is not given.
    """
    images = video_images(path)
    given = options.camera_of(None)
    beside = path.with_suffix(".csv")
    odometry = options.odometry or (beside if beside.exists() else None)
    return complete(path, "video", given, images, None if odometry is None else read_poses(odometry))


def video_images(path: Path) -> Images:
    """Frames and their stamps; a frame that cannot be decoded ends the video.

    Raises:
        DeviceError: it cannot be read.
    """
    capture = _opened(path)
    stamps: list[int] = []
    begin = 0.0
    while _grabbed(capture):
        begin = begin if stamps else _begin(capture)
        stamp = 1e6 * capture.get(cv2.CAP_PROP_POS_MSEC)
        # A damaged header gives times that are no numbers.
        stamps.append(round(stamp) if abs(stamp) < MAX_STAMP_NS else 0)
    if len(stamps) < 2:
        lost = "; an MP4 that was cut off has lost its index" if path.suffix.lower() in INDEXED else ""
        raise DeviceError(f"{path}: no video that can be read{lost}")
    damage, assumed = _cut_off(path, capture, len(stamps), begin, stamps[-1] * 1e-9), ""
    if not all(before < after for before, after in itertools.pairwise(stamps)):
        # Some containers give no stamps for each frame.
        rate = capture.get(cv2.CAP_PROP_FPS)
        if not math.isfinite(rate) or rate * MAX_STAMP_NS < 1e9 * len(stamps):
            rate = 0.0
        assumed = "" if rate > 0 else f"frames without stamps: {ASSUMED_RATE:g} images a second are assumed"
        stamps = [round(1e9 * k / (rate if rate > 0 else ASSUMED_RATE)) for k in range(len(stamps))]
    if path.suffix.lower() in RAW and not assumed:
        rate = 1e9 / float(np.median(np.diff(stamps)))
        assumed = f"a video in no container has no times: {rate:.3g} images a second are assumed"
    return Images(np.array(stamps, np.int64), _sequential(path), damage, assumed)


def _opened(path: Path) -> cv2.VideoCapture:
    """Open a video.

    Raises:
        DeviceError: its frames are too large to be decoded.
    """
    # Another reader of OpenCV would try what FFmpeg cannot read, and print lines of its own.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        check_size(int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    except InvalidValue as error:
        raise DeviceError(f"{path}: {error}") from None
    return capture


def _grabbed(capture: cv2.VideoCapture) -> bool:
    """Whether there is a further frame; OpenCV raises at some damage."""
    try:
        return capture.grab()
    except cv2.error:
        return False


def _begin(capture: cv2.VideoCapture) -> float:
    """When the last grabbed frame is shown, s, by the video's clock: recorders of streams let it run on."""
    rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(PTS)
    begin = count / rate if rate > 0.0 else 0.0
    return begin if math.isfinite(begin) else 0.0


def _cut_off(path: Path, capture: cv2.VideoCapture, frames: int, begin_s: float, last_s: float) -> str:
    """What a video lacks of what its header says, in one line; empty if nothing.

    Stamps are compared, not counts: a recorder may skip frames and leave their places empty.

    Args:
        path: of it.
        capture: at its end.
        frames: that were read.
        begin_s: of the first by the video's clock: the length in the header of a Matroska counts from zero.
        last_s: of the last, since the first.
    """
    rate, stated = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    with path.open("rb") as file:
        kind, size = file.read(4), int.from_bytes(file.read(4), "little")
    avi = kind == b"RIFF"
    if avi and not 0 < size <= path.stat().st_size - 8:
        return f"{path}: cut off after {frames} frames, {last_s:.1f} s: the file ends before its index"
    if rate <= 0.0:
        return ""
    length, other = stated / rate - begin_s, 0.5 / rate if avi else OTHER_TRACK
    # A length that no drive has is FFmpeg's sign for an unknown one.
    if 0.0 < length < MAX_STAMP_NS * 1e-9 and length - (last_s + 1.0 / rate) > other:
        return f"{path}: cut off after {frames} frames, {last_s:.1f} s: its header says {length:.1f} s"
    return ""


def _sequential(path: Path) -> Callable[[int], NDArray[np.uint8]]:
    """Reads frames in ascending order quickly; going back starts the video again."""
    state: dict[str, cv2.VideoCapture] = {}
    at = 0

    def read(k: int) -> NDArray[np.uint8]:
        nonlocal at
        if "capture" not in state or k < at:
            state["capture"], at = _opened(path), 0
        while at < k and _grabbed(state["capture"]):
            at += 1
        try:
            good, frame = state["capture"].read()
        except cv2.error:
            good, frame = False, None
        if not good or frame is None:
            raise DeviceError(f"{path}: frame {k} cannot be decoded")
        at += 1
        grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        return np.asarray(grey, np.uint8)

    return read
