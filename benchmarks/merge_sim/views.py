"""Which images truly show the same surfaces: rays from one camera, looked for in the other, by brute force.

A grid of rays goes through each image to the nearest surface. The point where it ends is seen by another
camera too if it lies in that one's image and the ray from there to it ends at it, not before. If both shall
see it from one side, the two rays also meet at no more than a given angle: the walls of a corridor are seen
from either end, without common features. Robots hide nothing here: a moment later they were elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.world import PanelSet

COLUMNS, ROWS = 16, 12
"""Rays through each image."""
MARGIN = 0.02
"""A ray ends at a point if it ends no further before it than this, m,"""
MARGIN_SHARE = 0.01
"""and this share of the way."""
FAR = 1e6
"""A ray that meets nothing is as long, m."""


def views_shared(
    panels: PanelSet, camera: Camera, poses: Sequence[Pose2], least: float = 0.0, most_angle: float = math.pi
) -> Array:
    """How much of what either of two images shows the other one shows too, whichever is less.

    Args:
        panels: all surfaces, in world; each is seen from its front alone.
        camera: that took all the images.
        poses: N, `world_from_robot`.
        least: what is less than this need not be known.
        most_angle: rad; what the two look at from directions further apart is not shared.

    Returns:
        (N, N), symmetric: of the rays of the one image that end somewhere, the share that ends where the
        other one sees it; 0 where it is less than `least`.
    """
    pixels = np.stack(
        np.meshgrid(
            (np.arange(COLUMNS) + 0.5) * camera.width / COLUMNS - 0.5,
            (np.arange(ROWS) + 0.5) * camera.height / ROWS - 0.5,
        ),
        axis=-1,
    ).reshape(-1, 2)
    tips = camera.back_project(pixels, np.ones(len(pixels)))
    eye = np.array([camera.mount_forward, 0.0, camera.mount_height])
    eyes = [_in_world(pose, eye) for pose in poses]
    seen: list[Array] = []
    for pose, origin in zip(poses, eyes, strict=True):
        directions = _in_world(pose, tips) - origin
        reach = lengths(panels, origin, directions)
        ends = reach < FAR
        seen.append(origin + reach[ends, None] * directions[ends])
    shared = np.zeros((len(poses), len(poses)))
    for i, j in combinations_with_replacement(range(len(poses)), 2):
        share = 1.0
        for one, other in ((i, j), (j, i)):
            if share >= least:
                points = seen[one]
                there = _seen(panels, camera, poses[other], eyes[other], points, least)
                ways = points - eyes[one], points - eyes[other]
                cosines = (ways[0] * ways[1]).sum(axis=1) / np.linalg.norm(ways, axis=2).prod(axis=0)
                there &= cosines >= math.cos(most_angle) - 1e-9
                share = min(share, float(there.mean()) if len(points) else 0.0)
        shared[i, j] = shared[j, i] = share if share >= least else 0.0
    return shared


def _seen(
    panels: PanelSet, camera: Camera, pose: Pose2, origin: Array, points: Array, least: float
) -> NDArray[np.bool_]:
    """(N,) which of some points a camera sees; where fewer than `least` can be, which are in its image."""
    flat = pose.inverse().apply(points[:, :2])
    found: NDArray[np.bool_] = np.array(
        camera.contains(camera.project(np.column_stack([flat, points[:, 2]])))
    )
    if not found.any() or found.mean() < least:
        return found
    inside = np.flatnonzero(found)
    ways = points[inside] - origin
    distances = np.linalg.norm(ways, axis=1)
    short = 1.0 - MARGIN_SHARE - MARGIN / np.maximum(distances, MARGIN)
    found[inside] = lengths(panels, origin, ways) >= short
    return found


def lengths(panels: PanelSet, origin: Array, directions: Array) -> Array:
    """How many times its direction each ray goes before it meets the front of a panel; FAR if it meets none.

    Args:
        panels: N surfaces.
        origin: (3,) m, in world.
        directions: (K, 3), of any length.
    """
    # Panels look away from along x down; origin + t d = corner + u along + v down, by Cramer's rule.
    normals = np.cross(panels.along, panels.down)
    offsets = panels.corner - origin
    facing = directions @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.einsum("nk,nk->n", normals, offsets) / facing
        to_u, to_v = np.cross(panels.down, offsets), np.cross(offsets, panels.along)
        u = (directions @ to_u.T) / facing
        v = (directions @ to_v.T) / facing
    within = (facing > 0.0) & (t > 0.0) & (u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0)
    out: Array = np.where(within, t, FAR).min(axis=1, initial=FAR)
    return out


def _in_world(pose: Pose2, points_in_robot: Array) -> Array:
    """(..., 3) points of a robot that stands on the floor."""
    points = np.atleast_2d(points_in_robot)
    found = np.column_stack([pose.apply(points[:, :2]), points[:, 2]])
    return found.reshape(np.shape(points_in_robot))
