"""What a robot has learned of its geometry while it mapped, in a form that outlasts its process.

What is learned is what the robot uses instead of what it declares. It is a prior for the next start: used
from the first image on, and given up where images and wheels contradict it by more than both sigmas explain,
since a person may have moved the camera. It says nothing of another camera, nor beside another declaration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.correction import geometry_of
from mapweave.agent.calibration.parameter_sigmas import MODEL_SIGMAS, PRIOR_SIGMAS
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.pose import Array

P = Parameter
LEARNABLE = (P.WHEEL_SCALE, P.FORWARD, P.HEADING, P.PITCH, P.DELAY)
"""What a robot corrects by itself while it maps; see `online`."""
SAME = 1e-6
"""Values that differ by less are the same: a file rounds them."""


@dataclass(frozen=True)
class LearnedParameter:
    """One parameter.

    Attributes:
        value: as in `DriveGeometry.vector`.
        sigma: standard deviation, likewise; positive.
    """

    value: float
    sigma: float


@dataclass(frozen=True)
class LearnedGeometry:
    """What one robot has learned.

    Attributes:
        declared: what it declared then.
        intrinsics: fx, fy, cx, cy of its images then, px.
        parameters: that are used instead of what is declared.
    """

    declared: DriveGeometry
    intrinsics: tuple[float, float, float, float]
    parameters: Mapping[Parameter, LearnedParameter]

    @staticmethod
    def of(
        description: RobotDescription, vector: Array, sigmas: Array, used: NDArray[np.bool_]
    ) -> LearnedGeometry:
        """Take what is used of an estimate.

        Args:
            description: as it is declared.
            vector: (10,) values.
            sigmas: (10,) their standard deviations.
            used: (10,) which of them are used instead of what is declared.
        """
        parameters = {p: LearnedParameter(float(vector[p]), float(sigmas[p])) for p in LEARNABLE if used[p]}
        return LearnedGeometry(geometry_of(description), intrinsics_of(description), parameters)

    def fits(self, description: RobotDescription) -> bool:
        """Whether the robot has the same camera and declares the same geometry."""
        now, then = geometry_of(description).vector, self.declared.vector
        cameras = zip(intrinsics_of(description), self.intrinsics, strict=True)
        return bool(np.allclose(now, then, rtol=0.0, atol=SAME)) and all(
            math.isclose(here, there, rel_tol=SAME) for here, there in cameras
        )

    def over(self, declared: DriveGeometry) -> DriveGeometry:
        """What is learned; all else as declared."""
        vector = declared.vector
        for p, learned in self.parameters.items():
            vector[p] = learned.value
        return DriveGeometry.of(vector) if self.parameters else declared

    @property
    def sigmas(self) -> Array:
        """(10,) standard deviations of what is learned; 0 for what is declared."""
        return np.array([self.parameters[p].sigma if p in self.parameters else 0.0 for p in P])

    def words(self) -> list[str]:
        """What is learned, a few words each."""
        value, was = self.over(self.declared).vector, self.declared.vector
        texts = {
            P.WHEEL_SCALE: lambda v: f"wheels go {math.exp(v):z.3f} times as far as they report",
            P.FORWARD: lambda v: f"camera {v:z.2f} m ahead of the axle",
            P.HEADING: lambda v: f"camera's heading {math.degrees(v):z.1f} degrees",
            P.PITCH: lambda v: f"camera's pitch {math.degrees(v):z.1f} degrees",
            P.DELAY: lambda v: f"wheels {1e3 * v:z.0f} ms late to the images",
        }
        numbers = {
            P.WHEEL_SCALE: lambda v: f"{math.exp(v):z.3f}", P.FORWARD: lambda v: f"{v:z.2f}",
            P.HEADING: lambda v: f"{math.degrees(v):z.1f}", P.PITCH: lambda v: f"{math.degrees(v):z.1f}",
            P.DELAY: lambda v: f"{1e3 * v:z.0f}",
        }  # fmt: skip
        return [f"{texts[p](value[p])} (declared {numbers[p](was[p])})" for p in self.parameters]


def intrinsics_of(description: RobotDescription) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a robot's images, px."""
    camera = description.camera
    return camera.fx, camera.fy, camera.cx, camera.cy


def joined(value: float, sigma: float, other: float, its_sigma: float, p: Parameter) -> tuple[float, float]:
    """Two independent estimates of a parameter as one; what both err by alike does not average out.

    Args:
        value: of the one.
        sigma: its standard deviation.
        other: value of the other.
        its_sigma: its standard deviation.
        p: which parameter.
    """
    weight, its_weight = sigma**-2, its_sigma**-2
    mean = (weight * value + its_weight * other) / (weight + its_weight)
    alike = float(MODEL_SIGMAS[p])
    if p is P.WHEEL_SCALE:
        # The declared height of the camera is the same on each drive.
        alike = math.hypot(alike, PRIOR_SIGMAS[P.HEIGHT])
    return mean, max(math.sqrt(1.0 / (weight + its_weight)), min(alike, sigma, its_sigma))
