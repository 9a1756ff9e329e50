"""Ranges on the wire."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ranges import Ranges
from mapweave.wire.range_codec import pack_ranges, unpack_ranges


@given(st.binary(max_size=80))
def test_any_bytes_are_ranges_or_refused_and_encode_to_themselves(data):
    try:
        ranges = unpack_ranges(data)
    except InvalidMessage:
        return
    assert unpack_ranges(pack_ranges(ranges)).distances == pytest.approx(ranges.distances)
    assert (ranges.distances <= ranges.reach).all()


def test_sixteen_sensors_cost_fifty_bytes():
    ranges = Ranges.around(np.full(16, 3.0), tuple(np.arange(16) * np.pi / 8), 3.0, 0.16)
    assert len(pack_ranges(ranges)) == 50
    back = unpack_ranges(pack_ranges(ranges))
    assert back.reach == pytest.approx(3.16)
    assert (back.distances == back.reach).all()
    turned = np.exp(1j * back.bearings) - np.exp(1j * ranges.bearings)
    assert np.abs(turned).max() < 1e-4


def test_a_robot_without_sensors_is_no_evidence():
    assert len(Ranges.around(np.zeros(0), (), 0.0, 0.16)) == 0
    assert len(Ranges.around(np.zeros(3), (0.0,), 1.0, 0.16)) == 0


@pytest.mark.parametrize(
    ("bearings", "distances", "reach"),
    [([0.0], [], 1.0), ([0.0], [2.0], 1.0), ([0.0], [-0.1], 1.0),
     ([np.nan], [0.5], 1.0), ([0.0], [np.nan], 1.0),
     ([0.0], [0.5], 1e3), ([[0.0]], [[0.5]], 1.0)],
)  # fmt: skip
def test_mismatched_arrays_are_refused(bearings, distances, reach):
    with pytest.raises(InvalidValue):
        Ranges(np.array(bearings), np.array(distances), reach)


@given(st.integers(1, 60_000), st.lists(st.tuples(st.floats(-10, 10), st.floats(0, 1)), max_size=20))
def test_decoded_values_encode_to_the_same_bytes(reach_mm, sensors):
    """Things at the very end of the reach and sensors that look straight back once did not."""
    reach = reach_mm / 1000
    bearings, shares = np.array([*sensors, (np.pi, 0.999), (-np.pi, 1.0), (3.14159, 0.9999)]).T
    packed = pack_ranges(Ranges(bearings, shares * reach, reach))
    back = unpack_ranges(packed)
    assert pack_ranges(back) == packed
    assert ((back.distances < reach) == (shares * reach < reach * (1 - 1e-6))).all()
