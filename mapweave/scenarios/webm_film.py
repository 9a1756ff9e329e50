"""A film that any browser plays: VP8 in WebM."""

from __future__ import annotations

import os
import queue
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from mapweave.hybridmap.errors import InvalidFile
from mapweave.scenarios.film_frame import Frame

WAITING = 16
"""Frames that may wait for the encoder; then the trial waits, so that no film misses a frame."""
EXPECTED = b"is not supported with codec id"
"""OpenCV prints this for every WebM file and then writes a good one."""


class Film:
    """Takes frames and writes them, in a thread of its own: the encoder costs more than the drawing.

    Attributes:
        path: of the film; it is there once the film is closed.
        frames: how many were added.
    """

    def __init__(self, path: Path, frames_per_second: float = 20.0) -> None:
        """Begin a film.

        Args:
            path: ends in `.webm`.
            frames_per_second: of the film, independent of the time between the frames.

        Raises:
            InvalidFile: another ending.
        """
        if path.suffix != ".webm":
            raise InvalidFile(f"{path}: a film's name must end in .webm")
        self.path = path
        self.frames = 0
        self._rate = frames_per_second
        # OpenCV goes by the ending.
        self._beside = path.with_name(f".{path.stem}.part.webm")
        self._shape: tuple[int, ...] | None = None
        self._queue: queue.Queue[Frame | None] = queue.Queue(WAITING)
        self._writer: cv2.VideoWriter | None = None
        self._thread: threading.Thread | None = None
        self._failure = ""

    def __enter__(self) -> Film:
        """Nothing more to do."""
        return self

    def __exit__(self, *_: object) -> None:
        """Finish the film."""
        self.close()

    def add(self, frame: Frame) -> None:
        """Append a frame, (H, W, 3) blue, green, red; it must not be changed afterwards.

        Raises:
            InvalidFile: the film cannot be written, or is finished, or this frame has another size than the
                first.
        """
        if self._writer is None:
            self._begin(frame)
        elif self._thread is None:
            raise InvalidFile(f"{self.path}: the film is finished")
        if frame.shape != self._shape:
            raise InvalidFile(f"{self.path}: all frames of a film have one size")
        self._queue.put(frame)
        self.frames += 1

    def close(self) -> None:
        """Finish the film; without frames there is none. Idempotent.

        Raises:
            InvalidFile: OpenCV could not encode a frame.
        """
        if self._thread is None or self._writer is None:
            return
        self._queue.put(None)
        self._thread.join()
        self._thread = None
        self._writer.release()
        if self._failure:
            self._beside.unlink(missing_ok=True)
            raise InvalidFile(f"{self.path}: OpenCV cannot write it ({self._failure})")
        self._beside.replace(self.path)

    def _begin(self, frame: Frame) -> None:
        height, width = frame.shape[:2]
        self._shape = frame.shape
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # OpenCV prints several lines about a path that cannot be written, and none gives the reason.
            self._beside.touch()
        except OSError as error:
            raise InvalidFile(f"{self.path}: cannot be written ({error.strerror})") from None
        with _without_expected_words():
            code = cv2.VideoWriter.fourcc(*"VP80")
            writer = cv2.VideoWriter(str(self._beside), code, self._rate, (width, height))
        if not writer.isOpened():
            self._beside.unlink(missing_ok=True)
            raise InvalidFile(f"{self.path}: OpenCV cannot write VP8 in WebM here")
        self._writer = writer
        self._thread = threading.Thread(target=self._encode, args=(writer,), name="film", daemon=True)
        self._thread.start()

    def _encode(self, writer: cv2.VideoWriter) -> None:
        """Take every frame, also after a failure: who adds must never wait for ever."""
        while (frame := self._queue.get()) is not None:
            if self._failure:
                continue
            try:
                writer.write(frame)
            except cv2.error as error:
                self._failure = str(error.err or error).strip().splitlines()[0]


@contextmanager
def _without_expected_words() -> Iterator[None]:
    """Keep one line of OpenCV's C code off stderr; other output is passed on."""
    sys.stderr.flush()
    stderr = 2
    with tempfile.TemporaryFile() as captured:
        kept = os.dup(stderr)
        os.dup2(captured.fileno(), stderr)
        try:
            yield
        finally:
            os.dup2(kept, stderr)
            os.close(kept)
            captured.seek(0)
            for line in captured:
                if EXPECTED not in line:
                    os.write(stderr, line)
