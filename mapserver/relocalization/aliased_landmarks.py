"""What looks like a place elsewhere on the map: the map knows its own doubles.

A view that shows one place may fit another as well and not be recognised there, because fewer of its features
happen to be landmarks there, or because they leave the pose open. Two nodes compare better: each holds its
best landmarks, with depths.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap import jit
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.place_hypotheses import NodeMatch
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.matching import MatchSettings, match
from mapweave.registration.recognition import Recognition, RecognitionSettings, register

REMEMBERED = 20_000
"""Pairs of nodes whose verdict is kept, the last ones asked about."""

VAGUE: dict[str, Any] = {
    "least_cells": 2, "most_position_share": 0.5, "most_heading_sigma": math.radians(20.0), "most_rival": 1.0,
}  # fmt: skip
"""What a node that looks like another need not hold: a poster seen from near fills few cells and tells no
pose well, and its double in the next room is one all the same."""

EXPLAINED_PX = 12.0
"""A match nearer than this to where a pose expects it speaks for that pose."""

NEAR_M, NEAR_HEADING = 0.5, 0.35
"""Two nodes see the same place, and are no doubles, if the map has them about where they see each
other, m and rad."""


class AliasedLandmarks:
    """Whether one node is recognised in another; remembered as long as both stay what they are."""

    def __init__(self, settings: RecognitionSettings) -> None:
        """Take when a place counts as recognised; a likeness may leave open where exactly it is seen from."""
        self._settings = replace(settings, **VAGUE)
        jit.load()  # when a server starts: a robot that asks must not wait for a compiler
        self._kept: OrderedDict[tuple[NodeId, NodeId], tuple[Node, Node, Recognition | None]] = OrderedDict()

    def compare(self, a: Node, b: Node) -> Recognition | None:
        """`a_from_b` and what both show, or None if they do not look alike."""
        key = a.id, b.id
        known = self._kept.get(key)
        if known is not None and unchanged(known[0], a) and unchanged(known[1], b):
            return known[2]
        found = register(a, b, self._settings, np.random.default_rng(0))
        self._kept[key] = a, b, found
        while len(self._kept) > REMEMBERED:
            self._kept.popitem(last=False)
        return found


def unchanged(one: Node, other: Node) -> bool:
    """Whether two nodes of one id look the same: without faded landmarks one is made anew each time."""
    if one is other:
        return True
    a, b = one.landmarks, other.landmarks
    alike = one.id == other.id and one.stamp_ns == other.stamp_ns and one.camera == other.camera
    return alike and np.array_equal(a.codes, b.codes) and np.array_equal(a.depths, b.depths, equal_nan=True)


def between(merged: MergedMap, a: NodeId, b: NodeId) -> Pose2 | None:
    """Pose `a_from_b` on a merged map; None if that does not join the two."""
    component = merged.component_of(a)
    if component is None or component != merged.component_of(b):
        return None
    return merged.pose(a).inverse() @ merged.pose(b)


def carried(
    double: Node,
    likeness: Recognition,
    seen: NodeMatch,
    view: View,
    matching: MatchSettings,
    within_px: float,
) -> NodeMatch:
    """What follows for a node that looks like one that was recognised.

    Args:
        double: the node that looks like it.
        likeness: `double_from_node`, with landmarks of the double and of the node that agree.
        seen: that the node was recognised in the view.
        view: the image's features.
        matching: how features are matched.
        within_px: a match nearer than this to where the pose expects it speaks for the double.

    Returns:
        A sighting of the double, of the features that it would explain: those of landmarks that both nodes
        have, and those that match the double's own. Its evidence tells the share seen of what should be.
    """
    pose = likeness.node_from_robot @ seen.recognition.node_from_robot
    points = double.landmarks.points_in_robot(double.camera)
    expected = view.camera.project(pose.mean.inverse().apply(points))
    feature_of = dict(seen.recognition.pairs.tolist())
    pairs = {i: feature_of[j] for i, j in likeness.pairs.tolist() if j in feature_of}
    taken = set(pairs.values())
    for i, j in match(double.landmarks.codes, view.codes, matching).tolist():
        off = expected[i] - view.pixels[j]
        if i not in pairs and j not in taken and math.hypot(off[0], off[1]) < within_px:
            pairs[i] = j
    should = int(view.camera.contains(expected).sum())
    recognition = replace(
        likeness,
        node_from_robot=pose,
        pairs=np.array(sorted(pairs.items()), np.int64).reshape(-1, 2),
        usable=seen.recognition.usable,
        evidence={**likeness.evidence, "seen": min(len(pairs) / max(should, 1), 1.0)},
    )
    return NodeMatch(double.id, recognition, alike=seen.node)


def same_place(one: Pose2, other: Pose2) -> bool:
    """Whether two poses are so near that vague estimates of one may be both."""
    return one.distance(other) < NEAR_M and abs(wrap_angle(one.heading - other.heading)) < NEAR_HEADING


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
        node_from_robot: from where, as it is thought.
        within_px: what is nearer is explained.
    """
    points = node.landmarks.take(pairs[:, 0]).points_in_robot(node.camera)
    off = camera.project(node_from_robot.inverse().apply(points)) - pixels[pairs[:, 1]]
    return len(pairs) - int((np.hypot(off[:, 0], off[:, 1]) < within_px).sum())


def elsewhere(ranked: Sequence[tuple[NodeId, float]], best: NodeId, faint: float) -> list[NodeId]:
    """Which nodes look at least so much like the view, as a share of how the best one does, best first."""
    least = faint * dict(ranked).get(best, 0.0)
    return [node for node, score in ranked if node != best and score >= least]
