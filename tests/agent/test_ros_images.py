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


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (SimpleNamespace(data=b"no image"), "no JPEG, PNG, PGM or BMP file"),
        (SimpleNamespace(data=b""), "no JPEG, PNG, PGM or BMP file"),
        (image(width=2**16, height=2**16), "65536x65536 px is too large"),
        (image(step=2**32 - 1), "has 48 bytes"),
        (image(encoding="32FC1"), "are not supported"),
    ],
)
def test_what_is_no_image_is_refused_in_words(wrong: SimpleNamespace, words: str):
    with pytest.raises(DeviceError, match=words):
        grey_of(wrong)
