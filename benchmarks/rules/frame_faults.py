"""What goes wrong with images and wheels on a drive: drives are spoiled after they were recorded."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Observation, Odometry
from mapweave.hybridmap.pose import Pose2


class Sensed(NamedTuple):
    """One tick: what the robot sensed, and `world_from_robot`."""

    observation: Observation
    truth: Pose2


Drive = Sequence[Sensed]
Spoil = Callable[[Drive, np.random.Generator], Drive]

FIRST, EVERY = 60, 120
"""Tick of the first fault, and ticks from one to the next."""
STANDS = 40
"""Ticks that a robot stands where it was put down."""
LIGHTS = 1.0, 0.55, 1.5, 0.7
"""Of the lamps, one after the other, for so many ticks each:"""
LIT = 60
BLACK = 4.0
"""Mean of a black image, grey levels."""
NOISE = 1.5
"""Of a black image, and of one that is taken again from where the robot stands, grey levels."""


def _imaged(sensed: Sensed, image: NDArray[np.uint8] | None) -> Sensed:
    return Sensed(replace(sensed.observation, image=image), sensed.truth)


def _moved(sensed: Sensed, odometry: Odometry) -> Sensed:
    return Sensed(replace(sensed.observation, odometry=odometry), sensed.truth)


def _now_and_then(drive: Drive, ticks: int, spoiled: Callable[[int, int], Sensed]) -> Drive:
    """A drive with faults of so many ticks: `spoiled(tick, first tick of the fault)`."""
    out = list(drive)
    for first in range(FIRST, len(drive) - ticks - 20, EVERY):
        out[first : first + ticks] = [spoiled(tick, first) for tick in range(first, first + ticks)]
    return out


def _lit(sensed: Sensed, gain: float, noise: float = 0.0, rng: np.random.Generator | None = None) -> Sensed:
    """The image as bright, with as much noise, grey levels; a tick without one stays as it is."""
    image = sensed.observation.image
    if image is None:
        return sensed
    lit = gain * image
    if rng is not None:
        lit = lit + rng.normal(BLACK * (gain == 0.0), noise, image.shape)
    return _imaged(sensed, np.clip(lit, 0, 255).astype(np.uint8))


def repeated(drive: Drive, _: np.random.Generator) -> Drive:
    """A camera at half the rate whose driver gives each image twice."""
    return [_imaged(one, drive[k - k % 2].observation.image) for k, one in enumerate(drive)]


def elsewhere(drive: Drive, _: np.random.Generator) -> Drive:
    """Images of other things for 1.2 s: something is held before the lens."""

    def spoiled(tick: int, _: int) -> Sensed:
        return _imaged(drive[tick], drive[(tick + len(drive) // 2) % len(drive)].observation.image)

    return _now_and_then(drive, 12, spoiled)


def dark(drive: Drive, rng: np.random.Generator) -> Drive:
    """Black images for 1.5 s."""

    def spoiled(tick: int, _: int) -> Sensed:
        return _lit(drive[tick], 0.0, NOISE, rng)

    return _now_and_then(drive, 15, spoiled)


def lamps(drive: Drive, _: np.random.Generator) -> Drive:
    """Lamps that are switched every 6 s."""
    return [_lit(one, LIGHTS[k // LIT % len(LIGHTS)]) for k, one in enumerate(drive)]


def spinning(drive: Drive, _: np.random.Generator) -> Drive:
    """Wheels that spin for 1.5 s: they count 0.3 m/s too much."""

    def spoiled(tick: int, _: int) -> Sensed:
        odometry = drive[tick].observation.odometry
        return _moved(drive[tick], Odometry(odometry.forward + 0.03, odometry.turn))

    return _now_and_then(drive, 15, spoiled)


def carried(drive: Drive, rng: np.random.Generator) -> Drive:
    """Put down elsewhere three times, where the robot waits for 4 s; no encoder notices."""
    n, out = len(drive), list(drive[: len(drive) // 4])
    for part in (2, 1, 3):
        there = _moved(drive[part * n // 4], Odometry(0.0, 0.0))
        out += [_lit(there, 1.0, NOISE, rng) for _ in range(STANDS)]
        out += drive[part * n // 4 : (part + 1) * n // 4]
    begun, tick = drive[0].observation.stamp_ns, drive[1].observation.stamp_ns - drive[0].observation.stamp_ns
    return [
        Sensed(replace(one.observation, stamp_ns=begun + k * tick), one.truth) for k, one in enumerate(out)
    ]


FAULTS: Mapping[str, Spoil] = {
    "images that come twice": repeated,
    "other things": elsewhere,
    "black images": dark,
    "lamps": lamps,
    "spinning wheels": spinning,
    "carried": carried,
}
"""By what is wrong."""
