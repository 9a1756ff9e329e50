"""One node's landmarks as seen from another node, without occlusion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2


@dataclass(frozen=True, eq=False)
class ProjectedView:
    """A node's N landmarks from another view.

    Attributes:
        pixels: (N, 2) px, where they project.
        depths: (N,) m, before the view's camera.
        fits: (N,) which are inside the image, and about as far and from the same side as the node has them.
    """

    pixels: Array
    depths: Array
    fits: NDArray[np.bool_]

    @staticmethod
    def of(
        node: Node, view: Node, node_from_view: Pose2, margin_px: float, scale: float, aside: float
    ) -> ProjectedView:
        """Project them.

        Args:
            node: that has the landmarks.
            view: from which they are seen.
            node_from_view: relative pose.
            margin_px: a landmark fits if it projects this far inside the image,
            scale: if its distance has changed by at most this factor,
            aside: and if it is seen from a direction that differs by at most this, rad.
        """
        points = node.points_in_robot
        from_view = node_from_view.inverse().apply(points)
        pixels = view.camera.project(from_view)
        eye = np.array([node.camera.mount_forward, 0.0])
        eye_of_view = node_from_view.apply(np.array([[view.camera.mount_forward, 0.0, 0.0]]))[0, :2]
        ray, ray_of_view = points[:, :2] - eye, points[:, :2] - eye_of_view
        distance, view_distance = np.linalg.norm(ray, axis=1), np.linalg.norm(ray_of_view, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.maximum(distance, view_distance) / np.minimum(distance, view_distance)
            cosine = (ray * ray_of_view).sum(axis=1) / (distance * view_distance)
            alike = (ratio < scale) & (cosine > math.cos(aside))
        fits = view.camera.contains(pixels, margin_px) & alike
        return ProjectedView(pixels, from_view[:, 0] - view.camera.mount_forward, fits)
