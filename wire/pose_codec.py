"""Cameras and poses as packed bytes, little-endian."""

import struct

import numpy as np

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.limits import MAX_POSITION
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian

CAMERA = struct.Struct("<HH6d")
POSTURE = struct.Struct("<9f")
UPPER = np.triu_indices(3)

MAX_MEASURED = 1e5
"""Of nodes and ends of edges, m: a day's drive at 1 m/s, where float32 still resolves centimetres."""

MAX_VARIANCE = 1e4
"""Largest eigenvalue of a covariance, m^2 or rad^2: who is off by 100 m knows nothing."""


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


def pack_pose(pose: PoseGaussian, farthest: float = MAX_POSITION) -> bytes:
    """Encode a pose: mean x, y, heading, then the covariance's upper triangle by rows, nine float32.

    Greater variances become the greatest.

    Raises:
        InvalidValue: a number is out of the range that `unpack_pose` accepts.
    """
    try:
        data = POSTURE.pack(*pose.mean.vector, *_limited(pose.covariance)[UPPER])
        unpack_pose(data, farthest)
    except (OverflowError, InvalidMessage) as error:
        raise InvalidValue(f"pose: {error}") from None
    return data


def _limited(covariance: Array) -> Array:
    """(3, 3) with no eigenvalue above the greatest, the same where there is none."""
    if covariance.trace() <= MAX_VARIANCE:
        return covariance
    values, vectors = np.linalg.eigh(covariance)
    # Rounding to float32 may make it a little more.
    limited: Array = vectors * np.clip(values, 0.0, MAX_VARIANCE * (1.0 - 1e-6)) @ vectors.T
    return limited if values[-1] > MAX_VARIANCE else covariance


def unpack_pose(data: bytes, farthest: float = MAX_POSITION) -> PoseGaussian:
    """Decode a pose.

    Args:
        data: nine float32.
        farthest: greatest coordinate, m.

    Raises:
        InvalidMessage: wrong length, a number not finite or out of range, or no covariance.
    """
    if len(data) != POSTURE.size:
        raise InvalidMessage(f"pose: {len(data)} bytes instead of {POSTURE.size}")
    x, y, heading, *upper = POSTURE.unpack(data)
    # Written so that NaN fails.
    if not (abs(x) <= farthest and abs(y) <= farthest and abs(heading) <= MAX_POSITION):
        raise InvalidMessage(f"pose: a number is not finite, or further away than {farthest:g} m")
    if not all(abs(number) <= MAX_VARIANCE for number in upper):
        raise InvalidMessage(f"pose: its covariance is not finite or beyond {MAX_VARIANCE:g} m^2 or rad^2")
    xx, xy, xh, yy, yh, hh = upper
    covariance = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    if xx + yy + hh > MAX_VARIANCE and np.linalg.eigvalsh(covariance)[-1] > MAX_VARIANCE:
        raise InvalidMessage(f"pose: its covariance is beyond {MAX_VARIANCE:g} m^2 or rad^2")
    try:
        return PoseGaussian(Pose2(x, y, heading), covariance)
    except InvalidValue as error:
        raise InvalidMessage(str(error)) from None
