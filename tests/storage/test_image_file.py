"""Images from disk: as they were written, or one line that says what is wrong."""

import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.image_file import decode_grey, image_size, read_grey
from mapweave.storage.plan_image import plan_pixels

CAMERA = Camera(64, 48, 60, 60, 32, 24, 0.3)


def test_written_files_are_read(tmp_path):
    grey = np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8)
    path = tmp_path / "grün 1.png"
    cv2.imwrite(str(path), grey)
    for camera in (None, CAMERA):
        read = read_grey(path, camera)
        assert read.dtype == np.uint8
        assert np.array_equal(read, grey)
    cv2.imwrite(str(path), np.dstack([grey] * 3))
    assert np.array_equal(read_grey(path, CAMERA), grey)


@pytest.mark.parametrize("how", ["missing", "a folder", "empty", "text", "torn"])
def test_an_invalid_image_is_reported_in_one_line(tmp_path, how, capfd):
    path = tmp_path / "1.png"
    match how:
        case "a folder":
            path.mkdir()
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_text("no image")
        case "torn":
            path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 50)
    words = "no such file" if how == "missing" else "not an image that can be read"
    with pytest.raises(DeviceError, match=re.escape(f"{path}: {words}")):
        read_grey(path)
    # OpenCV has something to say of a torn file, and nothing of the others.
    assert how == "torn" or capfd.readouterr().err == ""


def test_an_image_of_another_camera_is_refused(tmp_path):
    path = tmp_path / "1.png"
    cv2.imwrite(str(path), np.zeros((48, 60), np.uint8))
    assert read_grey(path).shape == (48, 60)
    with pytest.raises(DeviceError, match=re.escape(f"{path}: 60x48 px, but camera.toml gives 64x48")):
        read_grey(path, CAMERA, "camera.toml")


def png(width: int, height: int) -> bytes:
    """A whole and valid PNG of zeros, which compress a thousandfold."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, row = zlib.compressobj(9), bytes(width + 1)
    packed = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


@pytest.mark.parametrize("chunk", [b"IDAT", b"IEND", b"tEXt"])
def test_a_png_whose_chunk_claims_gigabytes_is_not_decoded(chunk, monkeypatch):
    """The decoder takes as much memory as a chunk claims; found by fuzzing."""
    data = png(64, 48)
    at = data.find(chunk) if chunk in data else len(data)
    begin = data[: at - 4] if chunk in data else data[:-12]
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InvalidValue, match="the image is damaged"):
        decode_grey(begin + struct.pack(">I", 0x7FFFFFF0) + chunk + bytes(40))


def test_a_decoder_sees_a_png_to_its_end_alone(monkeypatch):
    """Behind an end without an image OpenCV goes on: it took 1.2 GB for 120 bytes; found by fuzzing."""
    whole = png(64, 48)
    claim = struct.pack(">I", 0x48000000) + b"IDAT" + bytes(40)
    assert np.array_equal(decode_grey(whole + claim), decode_grey(whole))
    seen: list[bytes] = []
    monkeypatch.setattr(cv2, "imdecode", lambda data, _: seen.append(data.tobytes()))
    head, end = whole[:33], whole[-12:]
    with pytest.raises(InvalidValue, match="the image is damaged"):
        decode_grey(head + end + claim)
    with pytest.raises(InvalidValue, match="the image is damaged"):
        plan_pixels(head + end + claim)
    assert seen == [head + end] * 2


@pytest.mark.parametrize("marker", [0x00, 0x01, 0xD0, 0xD7, 0xD8, 0xD9])
def test_a_frame_hidden_behind_a_bare_marker_is_not_decoded(marker, monkeypatch):
    """The decoder sees a segment where a reader of the head skipped one: an image of 16000x16000 px."""
    data = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes()
    at = data.index(b"\xff\xc0")
    end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    frame = data[at:end]
    large = frame[:5] + struct.pack(">HH", 16_000, 16_000) + frame[9:]
    hidden = large + data[2:at] + b"\xff\xfe" + struct.pack(">H", 2 + len(frame))
    skipped = bytes([0xFF, marker]) + struct.pack(">H", 2 + len(hidden))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InvalidValue, match="no JPEG, PNG, PGM or BMP file; convert it to PNG"):
        decode_grey(data[:2] + skipped + hidden + frame + data[end:])


def test_a_jpeg_of_thousands_of_segments_is_not_decoded(monkeypatch):
    """To read over the four million that fit into an upload takes seconds."""
    data = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes()
    segment = b"\xff\xe0\x00\x02"
    assert decode_grey(data[:2] + 500 * segment + data[2:]).shape == (48, 64)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InvalidValue):
        decode_grey(data[:2] + 2000 * segment + data[2:])


def test_a_bomb_in_a_recording_is_not_decoded(tmp_path, monkeypatch):
    path = tmp_path / "1.png"
    path.write_bytes(png(20_000, 2_600))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(DeviceError, match="an image of 20000x2600 px is too large: at most 50 megapixels"):
        read_grey(path, CAMERA)


@pytest.mark.parametrize(
    "head",
    [b"P5 #\r16000 16000 255\n64 48\n255\n", b"P5 64#16000 255\n48\n255\n", b"P5" + 4000 * b" " + b"x"],
    ids=["hidden in a comment", "hidden behind a number", "blanks"],
)
def test_a_pgm_is_refused_at_once_unless_its_size_is_plain(head, monkeypatch):
    """The decoder ends a comment at each line end, and knows none right behind a number."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InvalidValue):
        decode_grey(head + bytes(64 * 48))


@pytest.mark.parametrize("head", [b"P5 64 48 255\n", b"P5\n# by GIMP\n64 # wide\n#\n48\n255\n"])
def test_a_pgm_may_have_comments(head):
    assert decode_grey(head + bytes(64 * 48)).shape == (48, 64)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm", ".bmp"])
@pytest.mark.parametrize("size", [(48, 64), (5, 3)])
def test_the_size_is_read_from_the_head(size, suffix):
    grey = np.random.default_rng(0).integers(0, 255, size).astype(np.uint8)
    data = cv2.imencode(suffix, grey)[1].tobytes()
    assert image_size(data) == size[::-1]
    assert decode_grey(data).shape == size


def test_a_device_is_no_image():
    with pytest.raises(DeviceError, match="/dev/zero: not an image"):
        read_grey(Path("/dev/zero"))


def test_an_animated_png_is_decoded_as_a_still_one(monkeypatch):
    """Of 50 megapixels it took 670 MB instead of 145, to show its first frame."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        data = kind + content
        return struct.pack(">I", len(content)) + data + struct.pack(">I", zlib.crc32(data))

    grey = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    still = cv2.imencode(".png", grey)[1].tobytes()
    frame = struct.pack(">IIIIIHHBB", 0, 64, 48, 0, 0, 1, 1, 0, 0)
    begin, end = still[:33], still[33:-12]
    moving = begin + chunk(b"acTL", struct.pack(">II", 2, 0)) + chunk(b"fcTL", frame) + end
    moving += chunk(b"fdAT", bytes(4)) + still[-12:]
    assert np.array_equal(decode_grey(moving), grey)
    seen = list[bytes]()
    monkeypatch.setattr(cv2, "imdecode", lambda data, _: seen.append(data.tobytes()))
    with pytest.raises(InvalidValue, match="the image is damaged"):
        decode_grey(moving)
    assert seen == [still]
