"""Depths with which tracks come into the mapping filter."""

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.triangulation import triangulate
from mapweave.agent.mapping.track_history import TrackHistory
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2

PRIOR_SPREAD = 0.6
"""Sigma of a new landmark's inverse depth, as a share of the expected one."""
PRIOR_NEAR = 0.45
"""The same sigma is at least this over the camera's height: a landmark may always be about as near as the
floor. A robot before a bare wall would else take its nearness for a slip of the wheels."""
DOUBT = 2.0
"""Factor by which sigmas of triangulated depths are enlarged."""
MOST_CHI2 = 4.0
"""Triangulated depths of tracks whose mean squared residual is above this are not used; 1 is expected."""


def initial_inverse_depths(
    ids: NDArray[np.int64],
    history: TrackHistory,
    camera: Camera,
    anchor_from_robot: Pose2,
    expected_depth: float,
    pixel_sigma: float,
) -> tuple[Array, Array]:
    """(N,) inverse depths 1/m of tracks, and their sigmas.

    Tracks that were followed outside of the filter are triangulated against its trajectory. Its errors are
    common to all of them, which their covariances do not contain.

    Args:
        ids: (N,) the tracks.
        history: from where they were seen.
        camera: that sees them.
        anchor_from_robot: where it is now.
        expected_depth: of a landmark of which nothing is known, m.
        pixel_sigma: of a track in an image, px.
    """
    inverse_depths = np.full(len(ids), 1.0 / expected_depth)
    nearest = PRIOR_NEAR / max(camera.mount_height, 0.05)
    sigmas = np.maximum(PRIOR_SPREAD * inverse_depths, nearest)
    poses, pixels = history.observations(ids)
    if len(poses) >= 2:
        solved = triangulate(poses, pixels, camera, pixel_sigma, anchor_from_robot.vector)
        better = DOUBT * np.sqrt(solved.ray_covariances[:, 2, 2])
        fits = (solved.chi2 < MOST_CHI2) & (better < sigmas)
        inverse_depths[fits], sigmas[fits] = solved.rays[fits, 2], better[fits]
    return inverse_depths, sigmas
