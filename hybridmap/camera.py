"""The pinhole camera on a planar robot."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics and mount of an ideal (undistorted) camera that faces along the robot's x axis.

    Frames: robot is x forward, y left, z up with its origin on the floor below the middle of the axle;
    camera is x right, y down, z forward. Pixels are undistorted: lens distortion is removed where images
    enter (mapweave.agent.vision) and is unknown from there on.

    Attributes:
        width: image width, px.
        height: image height, px.
        fx: focal length, px. `alpha_x` of the paper's equation (1).
        fy: focal length, px.
        cx: principal point, px.
        cy: principal point, px.
        mount_height: height of the optical centre above the floor, m.
        mount_forward: distance of the optical centre ahead of the axle, m.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    mount_height: float
    mount_forward: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a size, focal length or mount out of range (InvalidValue)."""
        numbers = (self.fx, self.fy, self.cx, self.cy, self.mount_height, self.mount_forward)
        if not all(math.isfinite(n) for n in numbers):
            raise InvalidValue("camera: every number must be finite")
        if not (16 <= self.width <= 16384 and 16 <= self.height <= 16384):
            raise InvalidValue(f"camera: image size {self.width}x{self.height} is out of range 16..16384")
        if self.fx <= 0 or self.fy <= 0:
            raise InvalidValue("camera: focal lengths must be positive")

    @property
    def semi_aperture(self) -> float:
        """Horizontal semi-aperture Delta of the paper's equation (3), rad: the narrower side."""
        return math.atan(min(self.cx, self.width - self.cx) / self.fx)

    def project(self, points_in_robot: NDArray[Any]) -> Array:
        """Project points, equation (1).

        Args:
            points_in_robot: (..., 3) m, in robot.

        Returns:
            (..., 2) px; NaN for points less than 1 cm ahead of the optical centre.
        """
        p = np.asarray(points_in_robot, dtype=np.float64)
        depth = p[..., 0] - self.mount_forward
        depth = np.where(depth > 0.01, depth, np.nan)
        out = np.empty((*depth.shape, 2))
        out[..., 0] = self.cx - self.fx * p[..., 1] / depth
        out[..., 1] = self.cy - self.fy * (p[..., 2] - self.mount_height) / depth
        return out

    def back_project(self, pixels: NDArray[Any], depths: NDArray[Any]) -> Array:
        """Points seen at pixels at depths along the optical axis.

        Args:
            pixels: (..., 2) px.
            depths: (...) m, along the optical axis from the optical centre.

        Returns:
            (..., 3) m, in robot.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        depths = np.asarray(depths, dtype=np.float64)
        out = np.empty((*depths.shape, 3))
        out[..., 0] = depths + self.mount_forward
        out[..., 1] = -(pixels[..., 0] - self.cx) / self.fx * depths
        out[..., 2] = self.mount_height - (pixels[..., 1] - self.cy) / self.fy * depths
        return out

    def bearings(self, pixels: NDArray[Any]) -> Array:
        """Horizontal bearing gamma of equation (3), (...) rad, positive to the left."""
        return -np.arctan((np.asarray(pixels, dtype=np.float64)[..., 0] - self.cx) / self.fx)

    def contains(self, pixels: NDArray[Any], margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Whether pixels lie in the image, at least a margin from its border; NaN does not."""
        p = np.asarray(pixels, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside: NDArray[np.bool_] = (
                (p[..., 0] >= margin_px)
                & (p[..., 0] <= self.width - 1 - margin_px)
                & (p[..., 1] >= margin_px)
                & (p[..., 1] <= self.height - 1 - margin_px)
            )
        return inside
