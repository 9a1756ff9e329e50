"""Trajectory segments as packed bytes: 8 a moment, and 1 more a proximity sensor.

ages      K int16   1e-2 s
x, y      K int16   mm each
headings  K int16   1e-4 rad, within half a turn
distances K S uint8 as in `mapweave.wire.range_codec`

What was decoded encodes to the same bytes again.
"""

import numpy as np

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ranges import MOST as MOST_SENSORS
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import MOST, TrajectorySegment
from mapweave.wire.range_codec import pack_bearings, pack_distances, unpack_bearings, unpack_distances

AGE_STEP = 1e-2
"""s: at 0.5 m/s a robot moves by 5 mm in it."""
PLACE_STEP = 1e-3
"""m."""
MAX_SEGMENT_BYTES = MOST * (8 + MOST_SENSORS)


def pack_trajectory(segment: TrajectorySegment, reach: float) -> bytes:
    """Encode.

    Args:
        segment: a segment with at least one moment.
        reach: of the node's proximity sensors, m.
    """
    x, y, headings = segment.node_from_robot.T
    return (
        np.rint(segment.ages / AGE_STEP).astype("<i2").tobytes()
        + np.rint(np.concatenate([x, y]) / PLACE_STEP).astype("<i2").tobytes()
        + pack_bearings(headings)
        + pack_distances(segment.distances.ravel(), reach)
    )


def unpack_trajectory(data: bytes, ranges: Ranges) -> TrajectorySegment:
    """Decode the trajectory segment of a node whose proximity sensors are those of its ranges.

    Raises:
        InvalidMessage: it is none.
    """
    sensors = len(ranges)
    k, rest = divmod(len(data), 8 + sensors)
    if rest:
        raise InvalidMessage(f"trajectory: {len(data)} bytes are none with {sensors} sensors")
    ages, x, y = np.frombuffer(data, "<i2", 3 * k).astype(np.float64).reshape(3, k)
    headings = unpack_bearings(data[6 * k : 8 * k])
    distances = unpack_distances(data[8 * k :], ranges.reach).reshape(k, sensors)
    poses = np.stack([x * PLACE_STEP, y * PLACE_STEP, headings], axis=1)
    try:
        return TrajectorySegment(ages * AGE_STEP, poses, distances)
    except InvalidValue as error:
        raise InvalidMessage(str(error)) from None
