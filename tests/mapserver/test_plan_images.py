"""Images of plans on the server's disk."""

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.mapserver import plan_images
from mapweave.mapserver.plan_images import PlanImages


def png(grey: int, side: int = 4) -> bytes:
    return bytes(cv2.imencode(".png", np.full((side, side), grey, np.uint8))[1].tobytes())


def test_images_are_kept_by_content_and_outlast_a_restart(tmp_path):
    store = tmp_path / "s0.sqlite"
    images = PlanImages(store, ())
    first, again, other = images.put(png(1)), images.put(png(1)), images.put(png(2))
    assert first == again and first.sha256 in images and images.get(first.sha256) == png(1)
    assert len(list((tmp_path / "s0.sqlite.plans").iterdir())) == 2
    # What no plan uses any more goes with the next start.
    images = PlanImages(store, [first.sha256])
    assert first.sha256 in images and other.sha256 not in images
    with pytest.raises(InvalidFile, match="not on the server's disk"):
        images.get(other.sha256)
    (tmp_path / "s0.sqlite.plans" / f"{first.sha256}.png").write_bytes(png(3))
    with pytest.raises(InvalidFile, match="damaged"):
        images.get(first.sha256)
    # To add it again, as the error says, mends it.
    assert images.put(png(1)) == first and images.get(first.sha256) == png(1)


def test_what_is_no_image_and_too_many_are_refused(tmp_path, monkeypatch):
    images = PlanImages(tmp_path / "s0.sqlite", ())
    for data in (b"", b"GIF89a", bytes(2**24 + 1)):
        with pytest.raises(InvalidValue, match="a plan is a PNG file"):
            images.put(data)
    for name in ("../../etc/passwd", "A" * 64, ""):
        with pytest.raises(InvalidValue, match="is no name of an image"):
            images.get(name)
    monkeypatch.setattr(plan_images, "MOST_BYTES", len(png(1)) + 10)
    images.put(png(1))
    with pytest.raises(InvalidValue, match="no more are kept"):
        images.put(png(2))
