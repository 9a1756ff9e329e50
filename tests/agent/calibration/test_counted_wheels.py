"""Readings of the wheels, kept where pairs need them."""

import numpy as np

from mapweave.agent.calibration.counted_wheels import FIRST_ROOM, CountedWheels
from mapweave.agent.observation import Odometry


def counted(readings: int) -> CountedWheels:
    wheels = CountedWheels()
    for k in range(readings):
        wheels.add(0.1 * k, Odometry(0.02, 0.01 if k % 2 else -0.03))
    return wheels


def test_readings_are_summed_beyond_the_first_room():
    track = counted(FIRST_ROOM + 10).track()
    assert len(track.stamps) == FIRST_ROOM + 10
    assert np.allclose(np.diff(track.way), 0.02)
    assert np.isclose(track.turn[-1] - track.turn[-3], -0.02)


def test_between_pairs_is_forgotten_and_within_them_nothing_changes():
    wheels = counted(2000)
    first, last = np.array([20.0, 20.5, 120.0]), np.array([21.0, 21.5, 121.0])
    before = wheels.track().between(first, last)
    wheels.forget_between(first - 2.0, last + 2.0)
    assert len(wheels.track().stamps) < 150
    assert np.allclose(wheels.track().between(first, last), before, atol=1e-9)
    assert wheels.stamp == 199.9
    wheels.add(200.0, Odometry(1.0, 0.0))
    assert np.isclose(np.diff(wheels.track().way)[-1], 1.0)


def test_without_readings():
    wheels = CountedWheels()
    wheels.forget_between(np.zeros(0), np.zeros(0))
    assert wheels.stamp == -np.inf
    assert wheels.way == 0.0
