"""Ranges as packed bytes: 3 a sensor.

reach     uint16    mm, from the robot's middle
bearings  K int16   1e-4 rad, within half a turn
distances K uint8   255: nothing in reach; else that share of 254 of the reach, 254 a hair less than all of it

What was decoded encodes to the same bytes again.
"""

import math

import numpy as np

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.ranges import Ranges

BEARING_STEP = 1e-4
"""rad: 1 mm at 10 m."""
MOST_STEPS = 31415
"""Bearings of half a turn to either side are the same; one step more would come back as the other."""

JUST_SEEN = 1.0 - 1e-5
"""What is seen at the very end of the reach is seen, and must not come back as nothing."""


def pack_ranges(ranges: Ranges) -> bytes:
    """Encode."""
    reach_mm = np.uint16(round(ranges.reach * 1000))
    return (
        reach_mm.tobytes() + pack_bearings(ranges.bearings) + pack_distances(ranges.distances, ranges.reach)
    )


def unpack_ranges(data: bytes) -> Ranges:
    """Decode.

    Raises:
        InvalidMessage: it is no packed ranges.
    """
    if len(data) < 2 or (len(data) - 2) % 3:
        raise InvalidMessage(f"ranges: {len(data)} bytes are none")
    count = (len(data) - 2) // 3
    reach = int(np.frombuffer(data, "<u2", 1)[0]) / 1000.0
    bearings = unpack_bearings(data[2 : 2 + 2 * count])
    try:
        return Ranges(bearings, unpack_distances(data[2 + 2 * count :], reach), reach)
    except InvalidValue as error:
        raise InvalidMessage(str(error)) from None


def pack_bearings(bearings: Array) -> bytes:
    """Encode (K,) rad: 2 bytes each, within half a turn."""
    turned = np.remainder(np.asarray(bearings) + math.pi, math.tau) - math.pi
    return np.clip(np.rint(turned / BEARING_STEP), -MOST_STEPS, MOST_STEPS).astype("<i2").tobytes()


def unpack_bearings(data: bytes) -> Array:
    """(K,) rad, of 2 K bytes.

    Raises:
        InvalidMessage: one lies beyond half a turn: it would not encode to the same bytes again.
    """
    steps = np.frombuffer(data, "<i2").astype(np.float64)
    if (np.abs(steps) > MOST_STEPS).any():
        raise InvalidMessage("a bearing lies beyond half a turn")
    out: Array = steps * BEARING_STEP
    return out


def pack_distances(distances: Array, reach: float) -> bytes:
    """Encode (K,) m, of sensors that reach so far, m: a byte each."""
    share = np.asarray(distances) / max(reach, 1e-9)
    steps = np.where(share >= 1.0 - 1e-6, 255, np.minimum(np.rint(share * 254), 254))
    return steps.astype(np.uint8).tobytes()


def unpack_distances(data: bytes, reach: float) -> Array:
    """(K,) m, of K bytes."""
    steps = np.frombuffer(data, np.uint8).astype(np.float64)
    out: Array = np.where(steps == 255, 1.0, np.minimum(steps / 254, JUST_SEEN)) * reach
    return out
