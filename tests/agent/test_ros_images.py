"""Images of ROS messages that are none: refused in one way, whatever is wrong with them."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from mapweave.agent.ros_messages.images import CHANNELS, GreyImages, grey_of
from mapweave.hybridmap.errors import DeviceError


def image(**changed: Any) -> SimpleNamespace:
    fields = {"encoding": "mono8", "width": 4, "height": 3, "step": 16, "is_bigendian": 0}
    return SimpleNamespace(**fields | {"data": np.zeros(48, np.uint8)} | changed)


@pytest.mark.parametrize("encoding", CHANNELS)
@pytest.mark.parametrize("size", [{"height": 0}, {"width": 0}, {"width": 0, "height": 2**32 - 1, "step": 0}])
def test_an_empty_image_is_refused(encoding: str, size: dict[str, int]):
    """One in colour ended an agent, or the replay of a bag, with a traceback of OpenCV."""
    assert grey_of(image(encoding=encoding)).shape == (3, 4)
    with pytest.raises(DeviceError, match=r"an image of \d+x\d+ px has 48 bytes"):
        grey_of(image(encoding=encoding, **size))


@pytest.mark.parametrize(("wrong", "words"), [
    (SimpleNamespace(format="h264", data=b"no image"), "of format 'h264': no JPEG, PNG, PGM or BMP file"),
    (SimpleNamespace(format="", data=b""), "no JPEG, PNG, PGM or BMP file"),
    (image(width=2**16, height=2**16), "65536x65536 px is too large"),
    (image(step=2**32 - 1), "has 48 bytes"),
    (image(encoding="32FC1"), "are not supported; mono8, .*bayer_rggb8, .* are"),
])  # fmt: skip
def test_what_is_no_image_is_refused_in_words(wrong: SimpleNamespace, words: str):
    with pytest.raises(DeviceError, match=words):
        grey_of(wrong)


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
@pytest.mark.parametrize("colour", ["r", "g", "b"])
def test_a_bayer_image_is_as_bright_as_one_in_colour(encoding: str, colour: str):
    """By its name, a red image in the wrong pattern is a blue one."""
    mosaic = np.zeros((6, 6), np.uint8)
    for k, cell in enumerate(encoding.split("_")[1][:4]):
        mosaic[k // 2 :: 2, k % 2 :: 2] = 200 * (cell == colour)
    grey = grey_of(image(encoding=encoding, width=6, height=6, step=6, data=mosaic.ravel()))
    flat = np.tile(np.array([200 * (each == colour) for each in "rgb"], np.uint8), 36)
    same = grey_of(image(encoding="rgb8", width=6, height=6, step=18, data=flat))
    np.testing.assert_allclose(grey, same, atol=1)


@pytest.mark.parametrize(("encoding", "first"), [("yuv422_yuy2", 0), ("yuyv", 0), ("yuv422", 1), ("uyvy", 1)])
def test_of_an_image_in_yuv_the_brightness_is_read(encoding: str, first: int):
    data = np.full(24, 128, np.uint8)
    data[first::2] = np.arange(12)
    grey = grey_of(image(encoding=encoding, step=8, data=data))
    np.testing.assert_array_equal(grey, np.arange(12).reshape(3, 4))


def deep(pixels: Any, big: bool) -> SimpleNamespace:
    data = np.asarray(pixels, ">u2" if big else "<u2").view(np.uint8).ravel()
    return image(encoding="16UC1", step=8, data=data, is_bigendian=int(big))


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_of_16_bits_those_that_the_camera_uses_are_read(bits: int, big: bool, caplog):
    """By their upper byte, images of 12 bits were called dark."""
    caplog.set_level("INFO")
    bright = np.linspace(0, 2**bits - 1, 12).astype(int).reshape(3, 4)
    images = GreyImages("/image")
    np.testing.assert_array_equal(images.read(deep(bright, big)), bright >> (bits - 8))
    # A lamp that is switched off is not made up for, and a brighter image shows that there are more bits.
    assert images.read(deep(bright // 8, big)).max() == 31
    assert images.read(deep(np.full((3, 4), 65535), big)).min() == 255
    assert images.read(deep(bright, big)).max() == (2**bits - 1) >> 8
    assert [f"/image: of 16 bits the images use {bits}" in line for line in caplog.messages] == [True] * (
        bits < 16
    )


def test_of_a_png_of_16_bits_and_of_a_mosaic_likewise():
    bright = np.linspace(0, 4095, 36).astype(np.uint16).reshape(6, 6)
    png = cv2.imencode(".png", bright)[1].tobytes()
    read = GreyImages("/image").read(SimpleNamespace(format="mono16; png compressed", data=png))
    np.testing.assert_array_equal(read, bright >> 4)
    flat = np.full(36, 3200, "<u2").view(np.uint8)
    mosaic = image(encoding="bayer_rggb16", width=6, height=6, step=12, data=flat)
    np.testing.assert_array_equal(GreyImages("/image").read(mosaic), 200)
