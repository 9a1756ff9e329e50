"""Landmark observations: which landmarks of a node a later view of its place shows.

A view should show a landmark if it projects well into the image, from a similar distance and direction, and
if no known depth of the view is nearer in that direction. It shows it if the two were matched when view and
node were linked, or if it has a landmark with a similar descriptor near the projection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import decode, rounding_noise
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.projected_view import ProjectedView
from mapweave.registration.matching import squared_distances

NEAR_PX = 25.0
"""A landmark is found again this near to where it projects, px,"""
ALIKE = 0.3
"""by a descriptor that is at most this far from its own; of two that have nothing to do with each other one
in a hundred is, in a whole image."""


@dataclass(frozen=True, eq=False)
class LandmarkObservations:
    """One later view's observation of a node's landmarks.

    Attributes:
        node: that has the landmarks.
        view: of its place.
        link: between the two, if there is one.
        between: node_from_view by which it was worked out.
        expected: (N,) which landmarks the view should show.
        found: (N,) which it shows.
        sure: whether the view's pose is certain.
    """

    node: Node
    view: Node
    link: Link | None
    between: Pose2
    expected: NDArray[np.bool_]
    found: NDArray[np.bool_]
    sure: bool = True

    @staticmethod
    def of(node: Node, view: Node, link: Link | None, node_from_view: Pose2) -> LandmarkObservations:
        """Search for a node's landmarks in a view.

        Args:
            node: that has the landmarks.
            view: of its place.
            link: between the two, if there is one.
            node_from_view: relative pose.
        """
        shown = expected(node, view, node_from_view)
        found = np.zeros(len(node.landmarks), np.bool_)
        if link is not None:
            found[link.shared[:, 0 if link.a == node.id else 1]] = True
        sought = np.flatnonzero(shown & ~found)
        if len(sought) and len(view.landmarks):
            points = node_from_view.inverse().apply(node.points_in_robot[sought])
            pixels = view.camera.project(points)
            apart = np.linalg.norm(pixels[:, None] - view.landmarks.pixels[None], axis=2)
            codes = node.landmarks.codes[sought], view.landmarks.codes
            unlike = squared_distances(decode(codes[0]), decode(codes[1])) - rounding_noise()
            found[sought] = ((apart < NEAR_PX) & (unlike < ALIKE**2)).any(axis=1)
        return LandmarkObservations(node, view, link, node_from_view, shown, found)


MARGIN_PX = 12.0
"""A landmark should be seen if it projects this far inside the image, px,"""
SCALE = 1.6
"""if its distance has changed by at most this factor,"""
ASIDE = math.radians(25.0)
"""and if it is seen from a direction that differs by at most this, rad."""
BEFORE_PX = 12.0
"""A landmark of the view hides it that is this near to it in the image, px,"""
BEFORE = 0.8
"""and at less than this share of its distance."""


def expected(old: Node, new: Node, old_from_new: Pose2) -> NDArray[np.bool_]:
    """(N,) which landmarks of a node another view should show."""
    projection = ProjectedView.of(old, new, old_from_new, MARGIN_PX, SCALE, ASIDE)
    shown, candidates = projection.fits, np.flatnonzero(projection.fits)
    if len(candidates):
        with_depth = new.landmarks.take(new.landmarks.has_depth)
        apart = np.linalg.norm(projection.pixels[candidates, None] - with_depth.pixels[None], axis=2)
        before = (apart < BEFORE_PX) & (
            with_depth.depths[None] < BEFORE * projection.depths[candidates, None]
        )
        shown[candidates[before.any(axis=1)]] = False
    return shown
