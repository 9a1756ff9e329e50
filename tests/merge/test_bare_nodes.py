"""Nodes whose landmarks have no depth: links use the depths of the other side, and invent none."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.verification import verify
from synthetic.world import room, take_node

HERE = PoseGaussian(Pose2(), np.zeros((3, 3)))


def bare(node: Node) -> Node:
    known, nothing = node.landmarks, np.full(len(node.landmarks), np.nan, np.float32)
    return replace(node, landmarks=Landmarks(known.pixels, known.codes, nothing, nothing))


@pytest.fixture(params=range(3))
def pair(request: pytest.FixtureRequest) -> tuple[Node, Node, Pose2]:
    rng = np.random.default_rng(request.param)
    world, a_from_b = room(0.0, 0.0, 6.0, 5.0, 900, rng), Pose2(-0.4, 0.3, -0.2)
    stand = Pose2(2.0, 2.5, 0.1)
    a = take_node(world, NodeId("r0", 1, 1), stand, HERE, rng)
    b = take_node(world, NodeId("r1", 1, 1), stand @ a_from_b, HERE, rng)
    return a, b, a_from_b


def test_depths_of_one_side_are_enough(pair):
    a, b, a_from_b = pair
    for first, second in ((a, bare(b)), (bare(a), b)):
        link = verify(first, second)
        assert isinstance(link, Link)
        assert link.a_from_b.mahalanobis2(a_from_b) < 25.0
        assert link.a_from_b.mean.distance(a_from_b) < 0.15


def test_without_any_depth_there_is_no_link(pair):
    a, b, _ = pair
    refused = verify(bare(a), bare(b))
    assert isinstance(refused, RefusedLink)
    assert "0 with a depth" in refused.reason
