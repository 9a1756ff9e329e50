"""A recognised view once more, with the noise that its pixels really have.

A recognition takes a pixel to be off by one: features found again at another scale are. Seen from nearly
where the node was made they are off by a tenth, and where the robot is follows so much more surely.
"""

import math

import numpy as np

from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.registration.gauss_newton import refine, stack_sightings
from mapweave.registration.planar_pose import PlanarPoseSettings
from mapweave.registration.recognition import Recognition, of_unknown_scale
from mapweave.registration.sightings import Sightings

LEAST_SIGMA, ROUNDS = 0.1, 3
"""px, pixels are rounded in a node; and how often the noise is estimated again."""

PRIOR_COUNT, PRIOR_SIGMA = 8, 0.5
"""Prior of a pixel's noise, as if from so many pixels, px: few pixels that happen to agree do not make a
sharp image."""

SHIFT_SIGMA = 0.1
"""px, what is left of a lens and of where features settle in a pixel, the same for a whole image."""

MAD_TO_SIGMA = 1.4826
"""A Gaussian's standard deviation over the median of its absolute values."""


def refine_pose(node: Node, view: View, recognition: Recognition, pose: PlanarPoseSettings) -> PoseGaussian:
    """Where the view was taken, by the landmarks that were recognised, weighted by what they are worth.

    The noise of a pixel is the median of what is left of all, so that a few wrong ones do not count; its
    upper limit is what the recognition took it to be.

    Args:
        node: the place.
        view: the image's features.
        recognition: that the view shows the node, by landmarks of the node that have a depth.
        pose: how poses are found.

    Returns:
        `node_from_robot`; that of the recognition where there is nothing to add.
    """
    landmarks = node.landmarks.take(recognition.pairs[:, 0])
    pixels = view.pixels[recognition.pairs[:, 1]].astype(np.float64)
    has_depth = landmarks.has_depth
    if int(has_depth.sum()) < pose.least_inliers:
        return recognition.node_from_robot
    landmarks, pixels = landmarks.take(has_depth), pixels[has_depth]
    points = landmarks.points_in_robot(node.camera)
    best, sigma, pitch = recognition.node_from_robot, pose.pixel_sigma, recognition.pitch
    scale_share, tilt_sigma = node.landmarks.scale_share, node.landmarks.tilt_sigma
    for _ in range(ROUNDS):
        level = Sightings.build(points, pixels, view.camera).levelled(pitch).pixels
        fresh = min(max(_noise(points, level, view, best), LEAST_SIGMA), pose.pixel_sigma)
        if fresh > 0.95 * sigma:
            break
        sigma = fresh
        covariances = landmarks.covariances_in_robot(node.camera, sigma, scale_share, tilt_sigma)
        sightings = Sightings.build(points, pixels, view.camera, covariances=covariances, pixel_sigma=sigma)
        stack = stack_sightings([sightings], pose.pitch_sigma)
        start = np.append(best.mean.vector, pitch / pose.pitch_sigma if pose.pitch_sigma else 0.0)
        fix = refine(stack, start, pose.scale_sigma, SHIFT_SIGMA)
        if fix is None or int(fix.inliers.sum()) < pose.least_inliers:
            break
        found = fix.node_from_robot
        found = PoseGaussian(found.mean, found.covariance + recognition.spread)
        refined = of_unknown_scale(found, scale_share, node.camera, view.camera)
        # Less noise leaves more pixels outside the gate. Where the rest says less than all did, the pose is
        # not better: with landmarks 50 to 300 m away, on a street, it was off by up to 21 m, not by 0.1.
        if np.trace(refined.covariance[:2, :2]) >= np.trace(best.covariance[:2, :2]):
            break
        best, pitch = refined, fix.pitch
    return best


def _noise(points: Array, pixels: Array, view: View, best: PoseGaussian) -> float:
    """px, standard deviation of a pixel around where its point should be."""
    off = pixels - view.camera.project(best.mean.inverse().apply(points))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(off - np.median(off, axis=0))))
    return math.sqrt((len(off) * spread**2 + PRIOR_COUNT * PRIOR_SIGMA**2) / (len(off) + PRIOR_COUNT))
