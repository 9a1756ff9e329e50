"""Films: read back by a decoder, and not a word on the terminal."""

import os
import threading

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.scenarios.webm_film import Film


def frames(count: int, size: tuple[int, int] = (320, 240)) -> list[np.ndarray]:
    """A bright square that moves 8 px a frame."""
    made = []
    for k in range(count):
        frame = np.full((size[1], size[0], 3), (40, 90, 160), np.uint8)
        frame[100:140, 20 + 8 * k : 60 + 8 * k] = 255
        made.append(frame)
    return made


def read(path) -> tuple[list[np.ndarray], float]:
    film, collected = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = film.read()
        if not there:
            return collected, film.get(cv2.CAP_PROP_FPS)
        collected.append(frame)


def test_a_film_has_its_frames_in_order(tmp_path, capfd):
    path = tmp_path / "made for it" / "film.webm"
    shown = frames(25)
    with Film(path, 12.5) as film:
        for frame in shown:
            film.add(frame)
        assert not path.exists(), "half a film is no film"
    assert film.frames == 25
    assert [p.name for p in path.parent.iterdir()] == ["film.webm"]
    assert path.read_bytes()[:4] == b"\x1a\x45\xdf\xa3"
    assert b"webm" in path.read_bytes()[:64]
    assert b"V_VP8" in path.read_bytes()[:1024]
    result, rate = read(path)
    assert rate == 12.5
    assert len(result) == 25
    for there, wanted in zip(result, shown, strict=True):
        assert np.abs(there.astype(int) - wanted).mean() < 6
    assert capfd.readouterr() == ("", "")


def test_other_words_on_stderr_are_passed_on(tmp_path, capfd, monkeypatch):
    """Only OpenCV's one expected line is suppressed; other output passes."""
    writer = cv2.VideoWriter

    def speaking(*arguments):
        os.write(2, b"the disk is nearly full\n")
        return writer(*arguments)

    speaking.fourcc = writer.fourcc
    monkeypatch.setattr(cv2, "VideoWriter", speaking)
    with Film(tmp_path / "film.webm") as film:
        film.add(frames(1)[0])
    assert capfd.readouterr().err == "the disk is nearly full\n"


def test_no_frames_no_film(tmp_path):
    with Film(tmp_path / "film.webm") as film:
        pass
    film.close()
    assert list(tmp_path.iterdir()) == []


def test_closing_twice_is_no_error(tmp_path):
    film = Film(tmp_path / "film.webm")
    film.add(frames(1)[0])
    film.close()
    film.close()
    assert (tmp_path / "film.webm").stat().st_size > 100
    assert not [t for t in threading.enumerate() if t.name == "film"]
    with pytest.raises(InvalidFile, match="is finished"):
        film.add(frames(1)[0])


def test_film_errors_are_reported_in_one_line(tmp_path):
    with pytest.raises(InvalidFile, match=r"must end in \.webm"):
        Film(tmp_path / "film.mp4")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InvalidFile, match="cannot be written"):
        Film(tmp_path / "file" / "film.webm").add(frames(1)[0])
    with Film(tmp_path / "film.webm") as film:
        film.add(frames(1)[0])
        with pytest.raises(InvalidFile, match="one size"):
            film.add(frames(1, (640, 480))[0])


def test_a_long_film_waits_for_the_encoder_and_misses_nothing(tmp_path):
    shown = frames(20) * 4
    with Film(tmp_path / "film.webm") as film:
        for frame in shown:
            film.add(frame)
    assert len(read(tmp_path / "film.webm")[0]) == 80


def test_a_failing_encoder_is_reported_in_one_line_and_blocks_no_other(tmp_path, monkeypatch):
    writer = cv2.VideoWriter

    class Failing:
        fourcc = writer.fourcc

        def __init__(self, *arguments):
            self.isOpened = lambda: True
            self.release = lambda: None

        def write(self, frame):
            cv2.resize(frame, (0, 0))  # an error of OpenCV itself

    monkeypatch.setattr(cv2, "VideoWriter", Failing)
    film = Film(tmp_path / "film.webm")
    for frame in frames(20) * 3:
        film.add(frame)
    with pytest.raises(InvalidFile, match="OpenCV cannot write it") as refusal:
        film.close()
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []
