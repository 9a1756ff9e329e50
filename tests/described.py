"""Images in which many robots of tests look for features are looked at once in a process."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest

from mapweave.vision.sift import NOTHING, Sift

if TYPE_CHECKING:
    import cv2

MOST = 400
"""Images that are remembered, about 100 kB each."""

_found: OrderedDict[bytes, tuple[Sequence[cv2.KeyPoint], np.ndarray]] = OrderedDict()
_describe = Sift.describe


def _described(
    self: Sift, image: np.ndarray, left_out: np.ndarray = NOTHING
) -> tuple[Sequence[cv2.KeyPoint], np.ndarray]:
    """What is found depends on the image and the settings, and where something is left out on the lens."""
    if len(left_out):
        return _describe(self, image, left_out)
    key = hashlib.blake2b(f"{self._settings} {image.shape}".encode(), digest_size=16)
    key.update(image.tobytes())
    if (found := _found.get(key.digest())) is None:
        found = _found[key.digest()] = _describe(self, image)
        if len(_found) > MOST:
            _found.popitem(last=False)
    return [*found[0]], found[1].copy()


@contextmanager
def described_once() -> Iterator[None]:
    """For tests of what is made of the features; those of the features themselves do without it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sift, "describe", _described)
        yield
