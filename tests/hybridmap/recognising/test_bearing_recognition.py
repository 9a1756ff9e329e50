"""Recognising places whose landmarks have no depth: theirs yes, others no."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hybridmap.node import CODE_BYTES, Landmarks, Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from hybridmap.recognising.bearing_recognition import recognise_bearings, usable_depths
from synthetic.world import room, take_node, take_view

HERE = PoseGaussian(Pose2(), np.zeros((3, 3)))


def bare(node: Node) -> Node:
    nothing = np.full(len(node.landmarks), np.nan, np.float32)
    known = node.landmarks
    return replace(node, landmarks=Landmarks(known.pixels, known.codes, nothing, nothing))


@pytest.mark.parametrize("seed", range(4))
def test_a_place_is_recognised_from_nearby_and_no_other_is(seed):
    rng = np.random.default_rng(seed)
    world = room(0.0, 0.0, 6.0, 5.0, 900, rng)
    stand = Pose2(2.0, 2.5, 0.1)
    node = bare(take_node(world, NodeId("r0", 1, 1), stand, HERE, rng))
    off = Pose2(-0.6, 0.3, -0.2)
    view, _ = take_view(world, stand @ off, rng)
    found = recognise_bearings(node, view, rng)
    assert found is not None
    camera_at = Pose2(node.camera.mount_forward)
    between = camera_at.inverse() @ off @ camera_at
    # All that is seen may hang on one wall, which can be explained from two sides (Longuet-Higgins
    # 1986); and a wrong match that lies near its line by chance pulls.
    direction = math.atan2(between.y, between.x)
    misses = [
        max(abs(wrap_angle(fix.heading - off.heading)), 0.2 * abs(wrap_angle(fix.direction - direction)))
        for fix in found.fixes
        if fix.directed
    ]
    assert min(misses) < 0.08
    assert found.inliers >= 12
    for heading in (1.6, 3.1, -1.6):
        elsewhere, _ = take_view(world, Pose2(2.0, 2.5, heading), rng)
        assert recognise_bearings(node, elsewhere, rng) is None


def test_random_matches_are_no_place():
    """The same descriptors at random pixels: every feature matches, and no line holds half of them."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        world = room(0.0, 0.0, 6.0, 5.0, 900, rng)
        node = bare(take_node(world, NodeId("r0", 1, 1), Pose2(2.0, 2.5, 0.1), HERE, rng))
        view, _ = take_view(world, Pose2(2.0, 2.5, 0.1), rng)
        size = [view.camera.width, view.camera.height]
        scattered = replace(view, pixels=rng.uniform(0, size, view.pixels.shape).astype(np.float32))
        assert recognise_bearings(node, scattered, rng) is None


def test_only_depths_known_to_a_share_are_usable():
    depths = np.array([2.0, 2.0, np.nan, 3.0], np.float32)
    sigmas = np.array([0.1, 1.5, np.nan, np.inf], np.float32)
    landmarks = Landmarks(np.zeros((4, 2), np.float32), np.zeros((4, CODE_BYTES), np.uint8), depths, sigmas)
    assert usable_depths(landmarks, 0.3) == 1
    assert usable_depths(Landmarks.empty(), 0.3) == 0
