"""What a drive tells of its geometry, and how surely."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.floor_scale import LEAST_FLOOR
from mapweave.agent.calibration.parameter_sigmas import PRIOR_SIGMAS, useful
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.hybridmap.pose import Array

P = Parameter
SIGNIFICANT = 3.5
"""Sigmas from the declared value at which a parameter is declared wrongly."""


class Lengths(Enum):
    """What besides the wheels shows how far a robot has gone."""

    FLOOR = "floor"
    """The floor, with the camera's declared height; or nothing, where none is seen."""
    RANGERS = "rangers"
    """Proximity sensors, and no floor."""
    BOTH = "both"
    """Both, and they agree."""
    CONTRADICT = "contradict"
    """Both, and one of them is wrong: the sensors are left out."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters with their covariance.

    Attributes:
        vector: (10,) in the order of `Parameter`.
        covariance: (10, 10).
        declared: (10,) before anything was seen.
        pairs: how many image pairs it is made of.
        floor_tracks: tracks on the floor in all of them.
        keep_wheels: whether the wheels' scale was held instead of the height.
        lengths: what besides the wheels shows how far the robot has gone.
    """

    vector: Array
    covariance: Array
    declared: Array
    pairs: int
    floor_tracks: int
    keep_wheels: bool = False
    lengths: Lengths = Lengths.FLOOR

    @property
    def geometry(self) -> DriveGeometry:
        """All estimated values, shown or not."""
        return DriveGeometry.of(self.vector)

    @property
    def sigmas(self) -> Array:
        """(10,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def shown(self) -> NDArray[np.bool_]:
        """(10,) which parameters the drive shows: better than useful, and much better than assumed.

        Without the floor nothing tells a scale, but for proximity sensors that of the wheels.
        """
        assumed = np.array([PRIOR_SIGMAS[p] for p in P])
        if self.keep_wheels:
            assumed[[P.WHEEL_SCALE, P.HEIGHT]] = assumed[[P.HEIGHT, P.WHEEL_SCALE]]
        shown = np.asarray((self.sigmas < useful(self.declared)) & (self.sigmas < 0.5 * assumed))
        floor = self.floor_tracks >= LEAST_FLOOR
        shown[[P.HEIGHT, P.LEFT]] &= floor
        shown[P.WHEEL_SCALE] &= floor or self.lengths is Lengths.RANGERS
        return shown

    @property
    def contradiction(self) -> tuple[Array, Array]:
        """How far the values are from the declared ones, and the sigmas by which that is named: `against`."""
        return self.against(self.declared)

    def against(self, vector: Array) -> tuple[Array, Array]:
        """(10,) how far the values are from others, and (10,) the sigmas by which they are contradicted.

        Where only the floor shows the wheels' scale, floor and wheels show its ratio to the height. That the
        ratio is wrong is surer than which of the two: what the height may be off is no part of its sigma.

        Args:
            vector: (10,) the others.
        """
        off, variances = self.vector - vector, np.diag(self.covariance).copy()
        if self.lengths in (Lengths.FLOOR, Lengths.CONTRADICT):
            ratio = np.zeros(len(off))
            ratio[[P.WHEEL_SCALE, P.HEIGHT]] = 1.0, -1.0
            off[P.WHEEL_SCALE] = ratio @ off
            variances[P.WHEEL_SCALE] = ratio @ self.covariance @ ratio
        return np.abs(off), np.sqrt(variances)

    @property
    def usable(self) -> DriveGeometry:
        """What the drive shows; all else as declared."""
        return DriveGeometry.of(np.where(self.shown, self.vector, self.declared))
