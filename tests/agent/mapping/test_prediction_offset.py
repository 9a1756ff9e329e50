"""How far tracks are from where the filter expects them."""

import numpy as np

from mapweave.agent.mapping.tracking import PredictionOffset


def test_recorded_observations_come_back_in_any_order():
    offset, ids = PredictionOffset(), np.array([9, 2, 5])
    pixels = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]])
    expected = np.array([[11.0, 18.0], [np.nan, np.nan], [50.0, 57.0]])
    offset.note(ids, pixels, expected)
    aside = offset.aside(np.array([5, 1, 2, 9, 12]))
    assert aside.tolist() == [[0.0, 3.0], [0.0, 0.0], [0.0, 0.0], [-1.0, 2.0], [0.0, 0.0]]


def test_of_no_tracks_nothing_is_known():
    offset = PredictionOffset()
    assert offset.aside(np.array([1, 2])).tolist() == [[0.0, 0.0], [0.0, 0.0]]
    offset.note(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
    assert offset.aside(np.zeros(0, np.int64)).shape == (0, 2)
