"""Aliased landmarks: similar places elsewhere on the map are searched in the map itself.

A view that shows one place may fit another as well and not be recognised there, because fewer of its features
happen to be landmarks there, or because they leave the pose open. Two nodes compare better: each holds its
best landmarks, with depths.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.recognition import Recognition, RecognitionSettings, register

VAGUE: dict[str, Any] = {"least_cells": 2, "most_rival": 1.0}
"""Looser thresholds for an alias: a poster seen from near fills few cells, and its copy in the next room is
an alias all the same."""

EXPLAINED_PX = 12.0
"""A match nearer than this to its prediction supports the pose."""

NEAR_M, NEAR_HEADING = 0.5, 0.35
"""Two nodes see the same place, and are not aliased, if the map has them about where they see each
other, m and rad."""


def alias(a: Node, b: Node, settings: RecognitionSettings) -> Recognition | None:
    """`a_from_b` and the common landmarks of two nodes that look alike, or None if they do not match.

    Args:
        a: one node.
        b: another.
        settings: when a place counts as recognised; an alias may leave open where exactly it is seen from.
    """
    return register(a, b, replace(settings, **VAGUE), np.random.default_rng(0))


def unchanged(first: Node, second: Node) -> bool:
    """Whether two nodes of one id have the same landmarks; without faded ones a node is a new object."""
    if first is second:
        return True
    a, b = first.landmarks, second.landmarks
    alike = first.id == second.id and first.stamp_ns == second.stamp_ns and first.camera == second.camera
    return alike and np.array_equal(a.codes, b.codes) and np.array_equal(a.depths, b.depths, equal_nan=True)


def between(merged: MergedMap, a: NodeId, b: NodeId) -> Pose2 | None:
    """Pose `a_from_b` on a merged map; None if that does not join the two."""
    component = merged.component_of(a)
    if component is None or component != merged.component_of(b):
        return None
    return merged.pose(a).inverse() @ merged.pose(b)


def same_place(a: Pose2, b: Pose2) -> bool:
    """Whether two poses are so near that vague estimates of one may be both."""
    return a.distance(b) < NEAR_M and abs(wrap_angle(a.heading - b.heading)) < NEAR_HEADING


def unexplained(
    node: Node,
    pairs: NDArray[np.int64],
    pixels: NDArray[np.float32],
    camera: Camera,
    node_from_robot: Pose2,
    within_px: float,
) -> int:
    """How many matches are not where a pose expects them.

    Args:
        node: whose landmarks were matched.
        pairs: (K, 2), landmark and feature.
        pixels: (N, 2) px, of the features.
        camera: that saw them.
        node_from_robot: estimated pose.
        within_px: what is nearer is explained.
    """
    points = node.landmarks.take(pairs[:, 0]).points_in_robot(node.camera)
    off = camera.project(node_from_robot.inverse().apply(points)) - pixels[pairs[:, 1]]
    return len(pairs) - int((np.hypot(off[:, 0], off[:, 1]) < within_px).sum())
