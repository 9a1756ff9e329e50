"""Cameras and postures as packed bytes, little-endian."""

from __future__ import annotations

import struct

import numpy as np

from hybridmap.camera import Camera
from hybridmap.errors import InvalidMessage, InvalidValue
from hybridmap.pose import Pose2, PoseGaussian

CAMERA = struct.Struct("<HH6d")
POSTURE = struct.Struct("<9f")
UPPER = np.triu_indices(3)

MAX_POSITION = 1e6
"""No robot drives farther from its start than this, m."""


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
    x, y, heading, *upper = POSTURE.unpack(data)
    # Written so that NaN fails.
    near = abs(x) <= MAX_POSITION and abs(y) <= MAX_POSITION and abs(heading) <= MAX_POSITION
    if not (near and all(abs(number) <= MAX_POSITION**2 for number in upper)):
        raise InvalidMessage("posture: a number is not finite or out of range")
    xx, xy, xh, yy, yh, hh = upper
    covariance = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    try:
        return PoseGaussian(Pose2(x, y, heading), covariance)
    except InvalidValue as error:
        raise InvalidMessage(str(error)) from None
