"""Calibration from a whole drive: image pairs, wheels, and whether the drive is one to learn from."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapweave.agent.calibration.camera_motions import WheelTrack, predict
from mapweave.agent.calibration.correction import geometry_of
from mapweave.agent.calibration.counted_wheels import CountedWheels
from mapweave.agent.calibration.estimate import Estimate
from mapweave.agent.calibration.estimator import Estimator
from mapweave.agent.calibration.floor_tiles import FloorTiles
from mapweave.agent.calibration.image_pairs import FEWEST_PAIRS, ImagePairs, sigma_of
from mapweave.agent.calibration.pair_information import ImagePair
from mapweave.agent.calibration.ranger_scale import RangerScale
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens

LEAST_S = 10.0
"""Of driving, s; half a minute is better."""
LEAST_TURN = 0.5
"""rad, either way, in all."""
HELD_OUT = 4
"""Each so-manieth pair is held out of the estimate that is checked on it."""


@dataclass(frozen=True)
class DriveCalibration:
    """What a drive shows.

    Attributes:
        estimate: from all pairs.
        declared_px: mean distance by which the wheels, with the declared geometry, misplace far points in
            the second images of pairs that were held out, px.
        estimated_px: the same with what the other pairs show.
    """

    estimate: Estimate
    declared_px: float
    estimated_px: float


def calibrate(
    description: RobotDescription, observations: Iterable[Observation], keep_wheels: bool = False
) -> DriveCalibration:
    """Estimate the geometry of a robot.

    Args:
        description: what it declares.
        observations: of the drive, in order.
        keep_wheels: hold the wheels' scale instead of the height.

    Raises:
        InvalidValue: the drive is too short, or never turns; one line says so.
    """
    camera = description.camera
    lens = Lens(camera, description.distortion)
    plain = Lens(camera) if lens.rectifies else lens
    images, tiles = ImagePairs(camera, plain), FloorTiles(camera, plain)
    counted, turned, rangers = CountedWheels(), 0.0, RangerScale(description)
    declared, sigma = geometry_of(description), sigma_of(camera)
    whole = Estimator(declared, sigma, keep_wheels)
    for observation in observations:
        stamp = 1e-9 * observation.stamp_ns
        counted.add(stamp, observation.odometry)
        turned += abs(observation.odometry.turn)
        rangers.step(observation.odometry, observation.proximity)
        if observation.image is not None:
            before = images.first
            pair = images.step(stamp, lens.rectified(observation.image))
            if pair is not None:
                parts = tiles.part(before), tiles.part(images.first)
                whole.add_with_floor(pair, counted.track(), tiles, *parts)
    pairs, wheels = whole.pairs, counted.track()
    driven = sum(pair.last_s - pair.first_s for pair in pairs)
    if len(pairs) < FEWEST_PAIRS or driven < LEAST_S:
        raise InvalidValue(
            f"too short: {driven:.0f} s in which the robot moves and points can be followed; "
            "drive for half a minute, with turns to both sides, where there is something to see"
        )
    if turned < LEAST_TURN:
        raise InvalidValue(
            f"the drive turns by {np.degrees(turned):.0f} degrees in all, and only turns show where the "
            "camera stands; drive curves to both sides"
        )
    held = pairs[HELD_OUT - 1 :: HELD_OUT]
    others = [pair for k, pair in enumerate(pairs) if k % HELD_OUT != HELD_OUT - 1]
    part = Estimator(declared, sigma, keep_wheels)
    part.ranged = whole.ranged = rangers.scale()
    trained = part.batch(others, wheels)
    estimate = whole.batch(pairs, wheels)
    # Of the parameters that are written: fewer pairs show fewer.
    checked = np.where(estimate.shown, trained.vector, declared.vector)
    misses = (_miss(part, held, wheels, v) for v in (declared.vector, checked))
    declared_px, estimated_px = (camera.fx * miss for miss in misses)
    return DriveCalibration(estimate, declared_px, estimated_px)


def _miss(estimator: Estimator, pairs: list[ImagePair], wheels: WheelTrack, vector: Array) -> float:
    """Mean angle between where the wheels expect a point ahead of typical depth and where it is, rad."""
    estimator.vector = vector
    misses = []
    for pair in pairs:
        seen = estimator.add(pair, wheels)
        predicted = predict(vector, wheels, np.array([pair.first_s]), np.array([pair.last_s]))
        off = predicted.since(seen.at[None])[0]
        rho = seen.inverse_depths[0]
        misses.append(np.hypot(off[4] + rho * off[0], -off[3] + rho * off[1]))
    return float(np.mean(misses))
