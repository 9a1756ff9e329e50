"""Landmarks and features of the first version of messages and map files, which are still read.

Columns of 16 bytes a descriptor (mapweave.hybridmap.descriptor_v1), then x and y (uint16 on the finest grid
that fits); landmarks have depth (uint16) and its sigma (uint8) besides, both logarithmic and 0 where they are
not known.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.descriptor_v1 import CODE_BYTES_V1, renew
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.node import Landmarks
from mapweave.hybridmap.quantization import PixelGrid

FEATURE_BYTES = CODE_BYTES_V1 + 4
LANDMARK_BYTES = FEATURE_BYTES + 3
MAX_LANDMARKS = 2000

DEPTH_LEAST, DEPTH_STEP = 0.01, math.log(1e6) / 65534
SIGMA_LEAST, SIGMA_STEP = 0.001, math.log(1e5) / 254
FINEST_SHIFT = 15
"""The grid of pixels was as fine as 16 bits allow."""


def unpack_landmarks_v1(data: bytes, camera: Camera) -> Landmarks:
    """Decode landmarks.

    Raises:
        InvalidMessage: a length that no number of landmarks has, or a sigma that does not go with its depth.
    """
    n = _count(data, LANDMARK_BYTES)
    features = n * FEATURE_BYTES
    depth = np.frombuffer(data, "<u2", n, features).astype(np.float64)
    sigma = np.frombuffer(data, np.uint8, n, features + 2 * n).astype(np.float64)
    known = depth > 0
    if (known != (sigma > 0)).any():
        raise InvalidMessage("landmarks: depth and sigma must both be known or both not")
    depths = np.where(known, DEPTH_LEAST * np.exp((depth - 1) * DEPTH_STEP), np.nan)
    sigmas = np.where(known, SIGMA_LEAST * np.exp((sigma - 1) * SIGMA_STEP), np.nan)
    pixels, codes = unpack_features_v1(data[:features], camera)
    return Landmarks(pixels, codes, depths.astype(np.float32), sigmas.astype(np.float32))


def unpack_features_v1(data: bytes, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Decode features into (N, 2) px and (N, 32) codes of today.

    Raises:
        InvalidMessage: a length that no number of features has.
    """
    n = _count(data, FEATURE_BYTES)
    codes = np.frombuffer(data, np.uint8, CODE_BYTES_V1 * n).reshape(n, CODE_BYTES_V1)
    x, y = np.frombuffer(data, "<u2", 2 * n, CODE_BYTES_V1 * n).reshape(2, n)
    return PixelGrid.of(camera, FINEST_SHIFT).restore(x, y), renew(codes)


def _count(data: bytes, each: int) -> int:
    n, rest = divmod(len(data), each)
    if rest or n > MAX_LANDMARKS:
        raise InvalidMessage(f"landmarks: {len(data)} bytes are no 0..{MAX_LANDMARKS} of the first version")
    return n
