"""Animated PNG files: what they hold besides one image is not decoded."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.storage.image_file import decode_grey


def test_an_animated_png_is_decoded_as_a_still_one(monkeypatch: pytest.MonkeyPatch) -> None:
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
