"""Images of ROS messages that are none: refused in one way, whatever is wrong with them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mapweave.agent.ros_messages.images import CHANNELS, grey_of
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
