"""Trajectory segments on the wire."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import MOST, TrajectorySegment
from mapweave.wire.trajectory_codec import pack_trajectory, unpack_trajectory

TWO = Ranges(np.array([0.0, 1.0]), np.array([2.0, 0.5]), 2.0)


@given(st.binary(max_size=80), st.sampled_from([TWO, Ranges()]))
@example(bytes(6) + struct.pack("<h", 31488) + bytes(2), TWO)  # a heading beyond half a turn
def test_any_bytes_are_a_trajectory_or_refused_and_encode_to_themselves(data, ranges):
    try:
        segment = unpack_trajectory(data, ranges)
    except InvalidMessage:
        return
    again = pack_trajectory(segment, ranges.reach)
    back = unpack_trajectory(again, ranges)
    assert back.node_from_robot == pytest.approx(segment.node_from_robot) and len(again) == len(data)
    assert pack_trajectory(back, ranges.reach) == again
    assert (segment.distances <= ranges.reach).all()


def test_a_moment_with_sixteen_sensors_costs_24_bytes():
    segment = TrajectorySegment(np.arange(3.0), np.zeros((3, 3)), np.ones((3, 16)))
    assert len(pack_trajectory(segment, 3.0)) == 3 * 24


@pytest.mark.parametrize("size", [1, 7, 9, 11, 10 * MOST + 10], ids=str)
def test_other_lengths_are_refused(size):
    with pytest.raises(InvalidMessage, match="trajectory"):
        unpack_trajectory(bytes(size), TWO)


@pytest.mark.parametrize(
    ("ages", "poses", "distances"),
    [([0.0], [[0.0, 0.0]], [[]]), ([0.0, 1.0], [[0.0] * 3], [[]]), ([1.0, 0.0], [[0.0] * 3] * 2, [[], []]),
     ([np.nan], [[0.0] * 3], [[]]), ([301.0], [[0.0] * 3], [[]]), ([0.0], [[31.0, 0.0, 0.0]], [[]]),
     ([0.0], [[0.0, 0.0, np.inf]], [[]]),
     (range(MOST + 1), np.zeros((MOST + 1, 3)), np.zeros((MOST + 1, 0)))],
)  # fmt: skip
def test_mismatched_arrays_are_refused(ages, poses, distances):
    with pytest.raises(InvalidValue, match="trajectory"):
        TrajectorySegment(np.array(ages, float), np.array(poses, float), np.array(distances, float))


@pytest.mark.parametrize("distances", [[[1.0]], [[1.0, 3.0]], [[1.0, -0.1]], [[1.0, np.nan]]])
def test_a_node_refuses_a_trajectory_of_other_sensors(some, distances):
    node = replace(some.node(), ranges=TWO)
    with pytest.raises(InvalidValue, match="trajectory"):
        replace(node, segment=TrajectorySegment(np.zeros(1), np.zeros((1, 3)), np.array(distances)))
