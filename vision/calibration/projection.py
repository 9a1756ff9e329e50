"""How lens models project the corners of a target, with derivatives."""

from typing import NamedTuple

import cv2
import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import LensModel

FOCAL = 4
"""The intrinsics begin with fx, fy, cx, cy; the lens's coefficients follow."""
COEFFICIENTS = {LensModel.RADIAL_TANGENTIAL: 5, LensModel.EQUIDISTANT: 4}
EXACT = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
"""When the iteration that takes distortion away ends: steps, and accuracy."""


class Projected(NamedTuple):
    """Pixels of N points.

    Attributes:
        pixels: (N, 2) px.
        by_intrinsics: (N, 2, 4 + K) derivative by fx, fy, cx, cy and the K coefficients.
        by_pose: (N, 2, 6) derivative by the rotation vector and the translation.
    """

    pixels: Array
    by_intrinsics: Array
    by_pose: Array


def project(model: LensModel, intrinsics: Array, pose: Array, points: Array) -> Projected:
    """Project points of a target.

    Args:
        model: of the lens.
        intrinsics: (4 + K,) px and coefficients.
        pose: (6,) rotation vector and translation, m: camera_from_target.
        points: (N, 3) m, on the target.
    """
    matrix, k = matrix_of(intrinsics), intrinsics[FOCAL:]
    turn, shift = pose[:3].copy(), pose[3:].copy()
    count = FOCAL + len(k)
    if model is LensModel.EQUIDISTANT:
        pixels, slopes = cv2.fisheye.projectPoints(points[:, None], turn, shift, matrix, k)
        by_intrinsics, by_pose = slice(0, count), slice(count, count + 6)
    else:
        pixels, slopes = cv2.projectPoints(points[:, None], turn, shift, matrix, k)
        by_intrinsics, by_pose = slice(6, 6 + count), slice(0, 6)
    slopes = np.asarray(slopes, np.float64).reshape(len(points), 2, -1)
    found = np.asarray(pixels, np.float64).reshape(-1, 2)
    return Projected(found, slopes[..., by_intrinsics], slopes[..., by_pose])


def rays_of(model: LensModel, intrinsics: Array, pixels: Array) -> Array:
    """(N, 2) tangents of the rays that (N, 2) px show; NaN where there is none.

    Raises:
        InvalidValue: the lens folds within the field that is used.
    """
    if model is LensModel.EQUIDISTANT:
        fx, fy, cx, cy, k1, k2, k3, k4 = (float(value) for value in intrinsics)
        return Equidistant(fx, fy, cx, cy, (k1, k2, k3, k4)).rays(pixels)
    matrix, k = matrix_of(intrinsics), intrinsics[FOCAL:]
    rays = cv2.undistortPoints(pixels[:, None], matrix, k, criteria=EXACT).reshape(-1, 2)
    return np.asarray(rays, np.float64)


def matrix_of(intrinsics: Array) -> Array:
    """(3, 3) of fx, fy, cx, cy."""
    fx, fy, cx, cy = intrinsics[:FOCAL]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
