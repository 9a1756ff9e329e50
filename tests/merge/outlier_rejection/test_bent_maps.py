"""Maps that are a little wrong everywhere, and maps of rooms that look alike."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.outlier_rejection.bent_maps import AGREEING, is_bent
from mapweave.merge.outlier_rejection.independent_support import ChanceSupport
from mapweave.merge.outlier_rejection.pairwise_consistency import loop_distances2, sort_links
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.outlier_rejection.wrong_geometry import link_sets
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.settings import ConsistencySettings
from synthetic.world import CAMERA

SIGMAS = np.array([0.015, 0.015, 0.008])
TOUR = [Pose2(2.5 + 1.5 * math.cos(0.5 * k), 2.0 + math.sin(0.5 * k), 0.7 * k) for k in range(20)]


def piece(agent: str, steps: list[Pose2]) -> Fragment:
    """The map of a robot that has measured these steps."""
    hybrid_map, still = HybridMap(), PoseGaussian(Pose2(), np.zeros((3, 3)))
    for k in range(len(steps) + 1):
        hybrid_map.apply(NodePut(Node(NodeId(agent, 1, 2 * k + 1), 0, still, CAMERA, Landmarks.empty())))
    for k, step in enumerate(steps, start=1):
        ends = NodeId(agent, 1, 2 * k - 1), NodeId(agent, 1, 2 * k + 1)
        pose = PoseGaussian(step, np.diag(SIGMAS**2))
        hybrid_map.apply(EdgePut(Edge(NodeId(agent, 1, 2 * k), *ends, pose, EdgeKind.MAPPED)))
    (fragment,) = fragments_of({MapId(agent, 1): hybrid_map})
    return fragment


def links(rng: np.random.Generator, shift: Pose2) -> list[Link]:
    """Each node of one map with two of the other; those of the second half where a shift puts them."""
    out = []
    for k, at in enumerate(TOUR):
        for j in (k, (k + 3) % len(TOUR)):
            there = (shift @ at) if k >= len(TOUR) // 2 else at
            noise = Pose2.from_vector(rng.normal(0.0, SIGMAS))
            pose = PoseGaussian(there.inverse() @ TOUR[j] @ noise, np.diag(SIGMAS**2))
            out.append(Link(NodeId("b", 1, 2 * k + 1), NodeId("a", 1, 2 * j + 1), pose))
    return out


def test_a_sound_map_hangs_together_though_links_are_a_little_off():
    """One pair of links in a hundred that fails the gate makes no second set of them; a bend does."""
    steps = [a.inverse() @ b for a, b in pairwise(TOUR)]
    fixed, sound = piece("a", steps), piece("b", steps)
    bent = piece("b", [Pose2(1.1 * s.x, 1.1 * s.y, s.heading) for s in steps])
    for seed in range(12):
        rng, s = np.random.default_rng(seed), ConsistencySettings()
        off = [
            replace(link, a_from_b=replace(link.a_from_b, mean=link.a_from_b.mean @ Pose2.from_vector(noise)))
            for link in links(rng, Pose2())
            for noise in [rng.normal(0.0, 2.5 * SIGMAS)]
        ]
        agree = loop_distances2(off, sound, fixed)[np.triu_indices(len(off), 1)] < s.gate
        assert 0.0 < (~agree).mean() < 0.05
        assert len(link_sets(off, sound, fixed, s)[0]) >= AGREEING * len(off)
        assert len(link_sets(off, bent, fixed, s)[0]) < AGREEING * len(off)


@pytest.mark.parametrize(
    ("scale", "shift", "bent"),
    [
        (1.1, Pose2(), True),
        (0.9, Pose2(), True),
        (1.0, Pose2(4.0), False),
        (1.0, Pose2(0.0, 3.0, math.pi), False),
    ],
)
def test_a_bent_map_is_at_one_place_and_a_second_room_is_at_another(scale: float, shift: Pose2, bent: bool):
    rng = np.random.default_rng(1)
    steps = [a.inverse() @ b for a, b in pairwise(TOUR)]
    placed = piece("b", [Pose2(scale * s.x, scale * s.y, s.heading) for s in steps])
    assert is_bent(links(rng, shift), placed, piece("a", steps)) is bent


@pytest.mark.parametrize(("scale", "shift", "false"), [(1.2, Pose2(), 0), (1.0, Pose2(4.0), 1)])
def test_what_contradicts_a_bent_map_is_no_evidence_of_false_places(scale: float, shift: Pose2, false: int):
    """Else one robot with a wrong way parts the maps of all others."""
    steps = [a.inverse() @ b for a, b in pairwise(TOUR)]
    placed = piece("b", [Pose2(scale * s.x, scale * s.y, s.heading) for s in steps])
    given = [link.turned() for link in links(np.random.default_rng(1), shift)]
    found = sort_links(given, piece("a", steps), placed)
    assert len(found.refused) >= 10, "they contradict each other"
    assert (ChanceSupport.of([found.supports[0]]).count > 0.5) is bool(false)
