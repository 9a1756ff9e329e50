"""Room to move and places that are known, against counting by hand and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.observation import RobotDescription
from agent.places import seen_around
from agent.room import ASIDE, BEFORE, room
from hybridmap.camera import Camera
from hybridmap.change import NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Landmarks, Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
BODY = RobotDescription(CAMERA, ranger_bearings=BEARINGS, ranger_reach=3.0)

readings = st.lists(st.floats(0.0, 3.0), min_size=16, max_size=16).map(np.array)
directions = st.sampled_from(BEARINGS)


@settings(max_examples=200, deadline=None)
@given(readings, directions)
def test_the_footprint_may_move_as_far_as_room_says(proximity, direction):
    """Moved step by step it comes no nearer to what the rangers hit than room promises."""
    angles = np.array(BEARINGS)
    hits = (proximity + BODY.radius)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ahead = np.array([math.cos(direction), math.sin(direction)])
    before = hits[(hits @ ahead) > 0.3 * np.linalg.norm(hits, axis=1)]
    for way in np.arange(0.0, room(BODY, proximity, direction), 0.01):
        gone = before - way * ahead
        along, aside = gone @ ahead, np.abs(gone @ [-ahead[1], ahead[0]])
        in_way = aside < BODY.radius + ASIDE - 1e-9
        assert (along[in_way] >= BODY.radius + BEFORE - 1e-6).all()


@settings(max_examples=100, deadline=None)
@given(readings, directions, st.integers(0, 15), st.floats(0.0, 1.0))
def test_what_comes_nearer_leaves_less_room(proximity, direction, which, share):
    nearer = proximity.copy()
    nearer[which] *= share
    assert room(BODY, nearer, direction) <= room(BODY, proximity, direction) + 1e-9


def test_without_rangers_nobody_knows():
    assert room(BODY, np.zeros(0), 0.0) == math.inf
    assert room(BODY, np.zeros(0), 0.0, 0.6) == 0.6
    one = RobotDescription(CAMERA, ranger_bearings=(math.pi,), ranger_reach=3.0)
    assert room(one, np.array([2.0]), 0.0, 0.6) == 0.6
    assert room(one, np.array([2.0]), math.pi) == pytest.approx(2.0 - BEFORE)


def a_map(*poses: Pose2) -> HybridMap:
    return HybridMap(
        NodePut(
            Node(NodeId("r0", 1, k + 1), 0, PoseGaussian.from_sigmas(p, 0.1, 0.1), CAMERA, Landmarks.empty())
        )
        for k, p in enumerate(poses)
    )


def test_a_place_is_seen_as_far_as_its_nodes_look():
    here = np.array([1.0, 2.0])
    share = 2 * CAMERA.semi_aperture / math.tau
    assert seen_around(HybridMap(), here, 0.7) == 0.0
    one = a_map(Pose2(1.2, 2.0, 0.3))
    assert seen_around(one, here, 0.7) == pytest.approx(share, abs=1 / 36)
    assert seen_around(one, here, 0.1) == 0.0
    assert seen_around(a_map(Pose2(1.2, 2.0, 0.3), Pose2(0.9, 2.0, 0.3)), here, 0.7) == pytest.approx(
        share, abs=1 / 36
    ), "twice the same way is no more"
    around = [Pose2(1.0, 2.1, heading) for heading in np.arange(0, math.tau, 0.9)]
    assert seen_around(a_map(*around), here, 0.7) == 1.0
