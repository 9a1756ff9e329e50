"""Lens distortion, removed from points rather than from images.

OpenCV is loaded when it is first needed: programs that only read settings start sooner.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.vision.equidistant import Equidistant

Coefficient = Annotated[float, Meta(ge=-1e4, le=1e4)]
RadialTangential = tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient]
"""(k1, k2, p1, p2, k3), OpenCV's order."""
Distortion = RadialTangential | Equidistant
"""Of a lens. The first has the ideal camera's focal length and principal point, the second its own."""

NO_DISTORTION: RadialTangential = (0.0, 0.0, 0.0, 0.0, 0.0)


class LensModel(StrEnum):
    """Names of the lens models in files and settings."""

    RADIAL_TANGENTIAL = "radial-tangential"
    EQUIDISTANT = "equidistant"


EXACT = (2 | 1, 60, 1e-10)
"""`TERM_CRITERIA_EPS | TERM_CRITERIA_COUNT`, steps, px: OpenCV's own five steps leave up to 0.1 px in the
corners of a webcam's image."""


class Lens:
    """Maps pixels of the real image to pixels of the ideal pinhole camera and back.

    Attributes:
        camera: the ideal one.
    """

    def __init__(self, camera: Camera, distortion: Distortion = NO_DISTORTION) -> None:
        """Take the ideal camera's intrinsics and the lens."""
        self._matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        self.camera = camera
        self._fisheye = distortion if isinstance(distortion, Equidistant) else None
        self._distortion = np.array([0.0] if isinstance(distortion, Equidistant) else distortion)
        self._maps: Any = None
        self._ideal = self._fisheye is None and not self._distortion.any()

    def undistort(self, raw: NDArray[Any]) -> Array:
        """(N, 2) px in the real image -> (N, 2) px in the ideal one."""
        raw = np.asarray(raw, dtype=np.float64).reshape(-1, 2)
        if self._ideal or not len(raw):
            return raw.copy()
        if self._fisheye is not None:
            c = self.camera
            return np.asarray(self._fisheye.rays(raw) * [c.fx, c.fy] + [c.cx, c.cy])
        import cv2

        out = cv2.undistortPoints(
            raw[:, None], self._matrix, self._distortion, P=self._matrix, criteria=EXACT
        )
        return np.asarray(out, dtype=np.float64).reshape(-1, 2)

    def distort(self, pixels: NDArray[Any]) -> Array:
        """(N, 2) px in the ideal image -> (N, 2) px in the real one."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        if self._ideal or not len(pixels):
            return pixels.copy()
        focal = np.array([self._matrix[0, 0], self._matrix[1, 1]])
        rays = np.ones((len(pixels), 3))
        rays[:, :2] = (pixels - self._matrix[:2, 2]) / focal
        if self._fisheye is not None:
            return self._fisheye.project(rays[:, :2])
        import cv2

        out, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self._matrix, self._distortion)
        return np.asarray(out, dtype=np.float64).reshape(-1, 2)

    @property
    def rectifies(self) -> bool:
        """Whether features are sought in a rectified image."""
        return self._fisheye is not None

    def rectified(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The (H, W) grey image of the ideal camera if the lens is a fisheye, else the image as it is.

        A webcam's distortion is removed from points, as every interpolation costs detail. A fisheye bends
        patches too much on their way through the image: see docs/decisions/fisheye.md.
        """
        return image if self._fisheye is None else self.undistorted(image)

    def undistorted(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The (H, W) grey image of the ideal camera."""
        if self._ideal:
            return image
        import cv2

        if self._maps is None:
            width, height = self.camera.width, self.camera.height
            pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
            at = self.distort(pixels).astype(np.float32).reshape(height, width, 2)
            self._maps = cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)
        whole, fraction = self._maps
        seen = cv2.remap(image, whole, fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, np.uint8)


def lens_of(image: Camera, model: LensModel, coefficients: Sequence[float]) -> tuple[Camera, Distortion]:
    """The ideal camera and the lens, from the intrinsics and the coefficients that a calibration gives.

    Args:
        image: size, focal length and principal point of the real image, and the mount.
        model: of the lens.
        coefficients: k1, k2, p1, p2, k3; or k1 to k4 of an equidistant lens. None are zeros.

    Raises:
        InvalidValue: their number is wrong, one is not finite, or the lens folds.
    """
    count = 4 if model is LensModel.EQUIDISTANT else 5
    known = [float(value) for value in coefficients] or [0.0] * count
    if len(known) != count:
        raise InvalidValue(f"a lens that is {model} has {count} coefficients, not {len(known)}")
    if not np.isfinite(known).all():
        raise InvalidValue("the lens's coefficients must be finite")
    if model is LensModel.RADIAL_TANGENTIAL:
        k1, k2, p1, p2, k3 = known
        return image, (k1, k2, p1, p2, k3)
    k1, k2, k3, k4 = known
    fisheye = Equidistant(image.fx, image.fy, image.cx, image.cy, (k1, k2, k3, k4))
    return fisheye.ideal(image.width, image.height, image.mount_height, image.mount_forward), fisheye
