"""Setup of a robot's camera: intrinsics, lens, shutter, noise; and some named cameras."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import Share
from mapweave.hybridmap.pose import Array
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import NO_DISTORTION, Distortion, RadialTangential

WEBCAM = Camera(width=320, height=240, fx=277.0, fy=277.0, cx=159.5, cy=119.5, mount_height=0.3)
"""60 degrees across, on a mast above the axle."""


Noise = Annotated[float, Meta(ge=0.0, le=60.0)]
MOST_DISTORTION = 10.0
"""Of a coefficient; those of lenses are below 1."""
LEAST_GROWTH = 0.02
"""How much of an area at the axis an area anywhere else in the picture takes at least."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """How brightness becomes grey levels.

    The automatic works as in small cameras: while the picture's mean is within a band around the wanted grey
    it does nothing, outside it moves the gain towards the wanted grey with a lag. Values saturate.

    Attributes:
        automatic: whether the gain follows the light at all.
        wanted: mean grey level that the automatic wants.
        band: logarithm of the ratio of mean and wanted grey that it tolerates.
        lag: time constant of the gain, s.
        lowest: gain.
        highest: gain; noise grows with it.
        gain_error: standard deviation of one camera's sensitivity from another's, as a share.
        vignetting: share of the light that is lost in the corners.
        seconds: how long the shutter is open, s; what the picture is blurred by when the robot turns.
    """

    automatic: bool = True
    wanted: Annotated[float, Meta(ge=1.0, le=254.0)] = 130.0
    band: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.5
    lag: Annotated[float, Meta(ge=0.0, le=60.0)] = 0.4
    lowest: Annotated[float, Meta(ge=1e-3, le=1.0)] = 0.25
    highest: Annotated[float, Meta(ge=1.0, le=1e3)] = 8.0
    gain_error: Annotated[float, Meta(ge=0.0, le=0.3)] = 0.0
    vignetting: Annotated[float, Meta(ge=0.0, le=0.95)] = 0.0
    seconds: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.0


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A robot's camera.

    Attributes:
        intrinsics: of the ideal pinhole, and where it is mounted.
        distortion: of the lens.
        read_noise: standard deviation of every pixel at gain 1, grey levels.
        shot_noise: standard deviation that a white pixel has in addition, grey levels; darker ones have less,
            by the square root of their brightness.
        exposure: brightness and shutter.
        dropped: probability that a tick has no frame.
    """

    intrinsics: Camera = WEBCAM
    distortion: Distortion = NO_DISTORTION
    read_noise: Noise = 2.0
    shot_noise: Noise = 0.0
    exposure: Exposure = field(default_factory=Exposure)
    dropped: Share = 0.0

    def __post_init__(self) -> None:
        """Refuse too large an image, and a lens that shows one point in two places (InvalidValue)."""
        if max(self.intrinsics.width, self.intrinsics.height) > 2048:
            raise InvalidValue("camera: the simulator draws at most 2048 pixels across and down")
        if isinstance(self.distortion, Equidistant):
            return
        within = all(abs(value) <= MOST_DISTORTION for value in self.distortion)
        if not (within and self._lens_is_single(self.distortion)):
            raise InvalidValue(
                f"camera: with distortion {list(self.distortion)} the lens folds the image's corners over: "
                "use smaller coefficients or a longer focal length"
            )

    def _lens_is_single(self, distortion: RadialTangential) -> bool:
        """Whether every pixel comes from one ray less than 80 degrees off the axis."""
        c = self.intrinsics
        columns, rows = np.linspace(0, c.width - 1, 33), np.linspace(0, c.height - 1, 25)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
        matrix = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
        lens = np.array(distortion)
        rays = undistorted(pixels, matrix, lens)
        if not np.isfinite(rays).all() or np.hypot(*rays.T).max() > math.tan(math.radians(80)):
            return False
        points = np.column_stack([rays, np.ones(len(rays))])
        again, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)
        if np.abs(again.reshape(-1, 2) - pixels.reshape(-1, 2)).max() > 0.05:
            return False
        # The distorted radius must grow clearly from the axis to every pixel: between the pixels that are
        # tested here it would fold otherwise, or Newton's method not converge.
        shares = np.linspace(0.0, 1.0, 40)[:, None, None]
        return bool((_jacobian(shares * rays, lens)[3] > LEAST_GROWTH).all())


def undistorted(pixels: NDArray[Any], matrix: NDArray[Any], lens: NDArray[Any]) -> Array:
    """(N, 2) tangents of the rays that (N, 1, 2) px of the real image show.

    OpenCV's fixed-point iteration diverges at the border of a wide lens, so Newton's method does it, on
    the same model (Brown-Conrady, as in cv2.projectPoints).
    """
    focal, centre = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2]
    wanted = (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - centre) / focal
    k1, k2, p1, p2, k3 = (float(k) for k in lens)
    rays: Array = wanted.copy()
    for _ in range(30):
        x, y = rays.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        off_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - wanted[:, 0]
        off_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - wanted[:, 1]
        xx, xy, yy, determinant = _jacobian(rays, lens)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.stack([yy * off_x - xy * off_y, xx * off_y - xy * off_x], axis=1) / determinant[:, None]
        # Short steps: far out, Newton would jump over the fold of the polynomial.
        rays -= np.clip(step, -0.2, 0.2)
        if not np.isfinite(step).all() or np.abs(step).max() < 1e-13:
            break
    return rays


def _jacobian(rays: Array, lens: NDArray[Any]) -> tuple[Array, Array, Array, Array]:
    """How a lens stretches the picture at (..., 2) rays: xx, xy, yy and the determinant, (...,) each."""
    k1, k2, p1, p2, k3 = (float(k) for k in lens)
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # of radial, by r2
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return xx, xy, yy, xx * yy - xy * xy


FISHEYE = Equidistant(fx=115.0, fy=115.4, cx=158.6, cy=120.9, k=(-0.02, 0.004, -0.003, 0.0005))

CAMERAS: dict[str, CameraSetup] = {
    "webcam": CameraSetup(),
    "wide": CameraSetup(
        Camera(width=320, height=240, fx=165.0, fy=165.0, cx=161.2, cy=118.4, mount_height=0.3),
        distortion=(-0.28, 0.07, 0.0006, -0.0004, 0.0),
        read_noise=2.5,
        shot_noise=2.0,
        exposure=Exposure(band=0.25, gain_error=0.05, vignetting=0.35),
    ),
    "phone": CameraSetup(
        Camera(width=320, height=240, fx=262.0, fy=262.4, cx=158.1, cy=121.0, mount_height=0.3),
        distortion=(0.08, -0.15, 0.0003, 0.0005, 0.02),
        read_noise=1.2,
        shot_noise=1.5,
        exposure=Exposure(band=0.15, lag=0.25, gain_error=0.03, vignetting=0.15, seconds=0.012),
    ),
    "cheap": CameraSetup(
        Camera(width=320, height=240, fx=250.0, fy=251.0, cx=155.0, cy=123.5, mount_height=0.3),
        distortion=(-0.18, 0.05, 0.001, -0.0008, 0.0),
        read_noise=4.5,
        shot_noise=4.0,
        exposure=Exposure(band=0.2, lag=0.8, gain_error=0.1, vignetting=0.3, seconds=0.02),
        dropped=0.02,
    ),
    "fisheye": CameraSetup(FISHEYE.ideal(320, 240, mount_height=0.3), distortion=FISHEYE),
}
"""Cameras by name: `webcam` is ideal but for noise; `wide` sees 106 degrees across and bends what it sees;
`fisheye` sees 160 degrees;
`phone` is sharp and quick but blurs a little in turns; `cheap` is noisy, slow to adapt, and drops frames."""
