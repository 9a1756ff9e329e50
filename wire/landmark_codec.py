"""Landmarks, cameras and postures as packed bytes: where nearly all of a map's size is.

Everything is little-endian. One landmark costs 23 bytes, stored in columns:

    codes    N x 16 bytes   compact descriptors, as they are
    x        N x uint16     (pixel + margin) * 2^k, see PixelGrid
    y        N x uint16
    depth    N x uint16     0: not known; else 1 cm * exp((q - 1) * DEPTH_STEP)
    sigma    N x uint8      0: with an unknown depth; else 1 mm * exp((q - 1) * SIGMA_STEP)

Errors: pixel half a grid step (1/32 px or less for images up to 2047 px), depth 0.011 % of itself, its sigma
2.3 % of itself. What was decoded encodes to the same bytes again.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.errors import InvalidMessage, InvalidValue
from hybridmap.node import CODE_BYTES, Landmarks
from hybridmap.pose import Pose2, PoseGaussian

MAX_LANDMARKS = 2000
LANDMARK_BYTES = CODE_BYTES + 2 + 2 + 2 + 1
FEATURE_BYTES = CODE_BYTES + 2 + 2

MIN_DEPTH, MAX_DEPTH = 0.01, 10_000.0
DEPTH_STEP = math.log(MAX_DEPTH / MIN_DEPTH) / 65534
MIN_SIGMA, MAX_SIGMA = 0.001, 100.0
SIGMA_STEP = math.log(MAX_SIGMA / MIN_SIGMA) / 254

CAMERA = struct.Struct("<HH6d")
POSTURE = struct.Struct("<9f")
UPPER = np.triu_indices(3)

MAX_POSITION = 1e6
"""No robot drives farther from its start than this, m."""


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """The finest grid of steps 2^-k px on which a camera's pixels fit into 16 bits.

    It reaches over the image's border by half the image on each side: removing lens distortion moves pixels
    outwards.

    Attributes:
        shift: k; a step is 2^-k px.
        margin_x: half the image's width, px.
        margin_y: half the image's height, px.
    """

    shift: int
    margin_x: int
    margin_y: int

    @staticmethod
    def of(camera: Camera) -> PixelGrid:
        """The grid for a camera's images."""
        reach = 2 * max(camera.width, camera.height)
        return PixelGrid((65535 // reach).bit_length() - 1, camera.width // 2, camera.height // 2)

    def quantise(self, pixels: NDArray[Any]) -> bytes:
        """The columns x and y of (N, 2) px.

        Raises:
            InvalidValue: a pixel is not finite or farther from the image than half its size.
        """
        from_margin = np.asarray(pixels, np.float64) + np.array([self.margin_x, self.margin_y])
        grid = np.rint(from_margin * 2.0**self.shift)
        # Written so that NaN fails.
        if not ((grid >= 0) & (grid <= 65535)).all():
            raise InvalidValue("landmarks: a pixel is not finite or far outside the image")
        columns: bytes = grid.astype("<u2").T.tobytes()
        return columns

    def restore(self, columns: bytes) -> NDArray[np.float32]:
        """(N, 2) px of the columns x and y."""
        grid = np.frombuffer(columns, "<u2").reshape(2, -1).T
        # Exact in float32: 16 bits scaled by a power of two, less a small integer.
        return (grid * 2.0**-self.shift - (self.margin_x, self.margin_y)).astype(np.float32)


def pack_landmarks(landmarks: Landmarks, camera: Camera) -> bytes:
    """Encode landmarks. Depths outside 1 cm .. 10 km become unknown, sigmas are clipped to 1 mm .. 100 m.

    Raises:
        InvalidValue: too many, a pixel off the image, a depth that is not positive, or one without sigma.
    """
    _check_count(len(landmarks))
    depths = landmarks.depths.astype(np.float64)
    if (depths <= 0).any():
        raise InvalidValue("landmarks: a depth is not positive")
    known = (depths >= MIN_DEPTH) & (depths <= MAX_DEPTH)
    sigmas = landmarks.depth_sigmas.astype(np.float64)[known]
    if not (np.isfinite(sigmas) & (sigmas >= 0)).all():
        raise InvalidValue("landmarks: a depth has no finite sigma")
    depth = np.zeros(len(landmarks), "<u2")
    depth[known] = 1 + np.rint(np.log(depths[known] / MIN_DEPTH) / DEPTH_STEP)
    sigma = np.zeros(len(landmarks), np.uint8)
    sigma[known] = 1 + np.rint(np.log(np.clip(sigmas, MIN_SIGMA, MAX_SIGMA) / MIN_SIGMA) / SIGMA_STEP)
    pixels = PixelGrid.of(camera).quantise(landmarks.pixels)
    return _pack_codes(landmarks.codes) + pixels + depth.tobytes() + sigma.tobytes()


def unpack_landmarks(data: bytes, camera: Camera) -> Landmarks:
    """Decode landmarks.

    Raises:
        InvalidMessage: a length that no number of landmarks has, or a sigma that does not go with its depth.
    """
    n, rest = divmod(len(data), LANDMARK_BYTES)
    if rest or n > MAX_LANDMARKS:
        raise InvalidMessage(f"landmarks: {len(data)} bytes are no 0..{MAX_LANDMARKS} landmarks")
    codes, pixels, depth, sigma = _split(data, 16 * n, 4 * n, 2 * n, n)
    depth_steps = np.frombuffer(depth, "<u2").astype(np.float64)
    sigma_steps = np.frombuffer(sigma, np.uint8).astype(np.float64)
    known = depth_steps > 0
    if (known != (sigma_steps > 0)).any():
        raise InvalidMessage("landmarks: depth and sigma must both be known or both not")
    depths = np.where(known, MIN_DEPTH * np.exp((depth_steps - 1) * DEPTH_STEP), np.nan)
    sigmas = np.where(known, MIN_SIGMA * np.exp((sigma_steps - 1) * SIGMA_STEP), np.nan)
    return Landmarks(
        PixelGrid.of(camera).restore(pixels),
        _codes(codes),
        depths.astype(np.float32),
        sigmas.astype(np.float32),
    )


def pack_features(pixels: NDArray[np.float32], codes: NDArray[np.uint8], camera: Camera) -> bytes:
    """Encode features without depth: the columns codes, x and y.

    Raises:
        InvalidValue: too many, shapes that do not belong together, or a pixel off the image.
    """
    _check_count(len(pixels))
    if (
        pixels.shape != (len(pixels), 2)
        or codes.shape != (len(pixels), CODE_BYTES)
        or codes.dtype != np.uint8
    ):
        raise InvalidValue(f"features: shapes {pixels.shape} and {codes.shape} do not belong together")
    return codes.tobytes() + PixelGrid.of(camera).quantise(pixels)


def unpack_features(data: bytes, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Decode features into (N, 2) px and (N, 16) codes.

    Raises:
        InvalidMessage: a length that no number of features has.
    """
    n, rest = divmod(len(data), FEATURE_BYTES)
    if rest or n > MAX_LANDMARKS:
        raise InvalidMessage(f"features: {len(data)} bytes are no 0..{MAX_LANDMARKS} features")
    codes, pixels = _split(data, 16 * n, 4 * n)
    return PixelGrid.of(camera).restore(pixels), _codes(codes)


def pack_camera(camera: Camera) -> bytes:
    """Encode a camera, exactly: width, height as uint16, then six float64 in the order of its fields."""
    return CAMERA.pack(
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.mount_height,
        camera.mount_forward,
    )


def unpack_camera(data: bytes) -> Camera:
    """Decode a camera.

    Raises:
        InvalidMessage: wrong length, or numbers that no camera has.
    """
    if len(data) != CAMERA.size:
        raise InvalidMessage(f"camera: {len(data)} bytes instead of {CAMERA.size}")
    numbers = CAMERA.unpack(data)
    if not all(abs(n) <= MAX_POSITION for n in numbers):
        raise InvalidMessage("camera: a number is out of range")
    try:
        return Camera(*numbers)
    except InvalidValue as error:
        raise InvalidMessage(str(error)) from None


def pack_posture(posture: PoseGaussian) -> bytes:
    """Encode a posture: mean x, y, heading, then the covariance's upper triangle by rows, nine float32.

    Raises:
        InvalidValue: a number is out of the range that `unpack_posture` accepts.
    """
    try:
        data = POSTURE.pack(*posture.mean.vector, *posture.covariance[UPPER])
        unpack_posture(data)
    except (OverflowError, InvalidMessage) as error:
        raise InvalidValue(f"posture: {error}") from None
    return data


def unpack_posture(data: bytes) -> PoseGaussian:
    """Decode a posture.

    Raises:
        InvalidMessage: wrong length, a number not finite or out of range, or no covariance.
    """
    if len(data) != POSTURE.size:
        raise InvalidMessage(f"posture: {len(data)} bytes instead of {POSTURE.size}")
    numbers = np.array(POSTURE.unpack(data))
    # Written so that NaN fails.
    if not ((np.abs(numbers[:3]) <= MAX_POSITION).all() and (np.abs(numbers[3:]) <= MAX_POSITION**2).all()):
        raise InvalidMessage("posture: a number is not finite or out of range")
    covariance = np.zeros((3, 3))
    covariance[UPPER] = numbers[3:]
    covariance = covariance + np.triu(covariance, 1).T
    try:
        return PoseGaussian(Pose2.from_vector(numbers[:3]), covariance)
    except InvalidValue as error:
        raise InvalidMessage(str(error)) from None


def _check_count(n: int) -> None:
    if n > MAX_LANDMARKS:
        raise InvalidValue(f"{n} landmarks, at most {MAX_LANDMARKS} are allowed")


def _pack_codes(codes: NDArray[np.uint8]) -> bytes:
    if codes.dtype != np.uint8:
        raise InvalidValue(f"descriptors must be uint8, not {codes.dtype}")
    return codes.tobytes()


def _codes(data: bytes) -> NDArray[np.uint8]:
    # A copy, so that the array can be written to and does not hold the whole message.
    return np.frombuffer(data, np.uint8).reshape(-1, CODE_BYTES).copy()


def _split(data: bytes, *lengths: int) -> list[bytes]:
    parts, begin = [], 0
    for length in lengths:
        parts.append(data[begin : begin + length])
        begin += length
    return parts
