"""The parameters that tie wheels and camera together."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

FARTHEST = 10.0
"""m; no robot has its lens higher above the floor, or farther from the axle: it is in millimetres."""


def check_mount(height: float, forward: float = 0.0) -> None:
    """Refuse a mount of a camera that cannot be right.

    Args:
        height: of the optical centre above the floor, m.
        forward: of it ahead of the axle, m.

    Raises:
        InvalidValue: which of them is too far, or is no number.
    """
    for name, value, least in (("height_m", height, 0.0), ("forward_m", forward, -FARTHEST)):
        if not least <= value <= FARTHEST:
            raise InvalidValue(
                f"camera: {name} is {value:g}; it is in metres, from {least:g} to {FARTHEST:g}"
            )


class Parameter(IntEnum):
    """Position of each parameter in a vector."""

    WHEEL_SCALE = 0
    """Logarithm of true over declared way."""
    TURN_SCALE = 1
    """Logarithm of true over declared turn."""
    DRIFT = 2
    """Turn that wheels of unequal size make unseen, rad/m."""
    FORWARD = 3
    """Optical centre ahead of the axle, m."""
    LEFT = 4
    """Optical centre left of the middle of the axle, m."""
    HEADING = 5
    """Of the optical axis, rad to the left of straight ahead."""
    PITCH = 6
    """Of the optical axis, rad below the horizon."""
    ROLL = 7
    """Of the image's right side, rad below its left side."""
    HEIGHT = 8
    """Logarithm of the optical centre's height over the floor in m."""
    DELAY = 9
    """Wheels' clock when an image was taken, less the image's stamp, s."""


COUNT = len(Parameter)


@dataclass(frozen=True)
class DriveGeometry:
    """Values of all parameters; the defaults are what a robot declares that knows of none.

    Attributes:
        wheel_scale: true way over the way that the wheels report.
        turn_scale: true turn over the turn that the wheels report.
        drift: turn that the wheels do not see, rad to the left for each metre ahead.
        forward: of the optical centre ahead of the axle, m.
        left: of the optical centre left of the middle of the axle, m.
        heading: of the optical axis to the left, rad.
        pitch: of the optical axis below the horizon, rad.
        roll: about the optical axis, rad; positive with the image's right side low.
        height: of the optical centre above the floor, m.
        delay: the wheels' reading that belongs to an image has this much later a stamp, s.
    """

    wheel_scale: float = 1.0
    turn_scale: float = 1.0
    drift: float = 0.0
    forward: float = 0.0
    left: float = 0.0
    heading: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    height: float = 1.0
    delay: float = 0.0

    @property
    def vector(self) -> Array:
        """(10,) in the order of `Parameter`; raises InvalidValue without a height above the floor."""
        if not self.height > 0.0:
            raise InvalidValue(
                f"camera: height_m is {self.height:g}; a robot needs its height above the floor"
            )
        return np.array(
            [
                math.log(self.wheel_scale), math.log(self.turn_scale), self.drift, self.forward, self.left,
                self.heading, self.pitch, self.roll, math.log(self.height), self.delay,
            ]
        )  # fmt: skip

    @staticmethod
    def of(vector: NDArray[Any]) -> DriveGeometry:
        """Build from (10,) in the order of `Parameter`."""
        s, r, drift, forward, left, heading, pitch, roll, h, delay = (float(v) for v in vector)
        return DriveGeometry(
            math.exp(s), math.exp(r), drift, forward, left, heading, pitch, roll, math.exp(h), delay
        )
