"""True views with wrong ways between them, and maps of rooms that look alike."""

from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.outlier_rejection.shuffled_maps import LEAST_PLACED, is_shuffled
from mapweave.merge.pose_graph.links import Link
from tests.merge.outlier_rejection.test_bent_maps import SIGMAS, TOUR, piece

TWIN = Pose2(12.0, 1.0, 2.0)


def links(seen: list[Pose2]) -> list[Link]:
    """Each node of a map with two of the map of the tour: it shows what is seen from there."""
    out = []
    for k, at in enumerate(seen):
        for j in (k, (k + 3) % len(TOUR)):
            noise = Pose2.from_vector(np.random.default_rng([k, j]).normal(0.0, SIGMAS))
            pose = PoseGaussian(at.inverse() @ TOUR[j] @ noise, np.diag(SIGMAS**2))
            out.append(Link(NodeId("b", 1, 2 * k + 1), NodeId("a", 1, 2 * j + 1), pose))
    return out


@pytest.mark.parametrize("count", [LEAST_PLACED, 9, 20])
def test_views_in_a_wrong_arrangement_are_no_second_place(count: int):
    rng = np.random.default_rng(count)
    fixed = piece("a", [a.inverse() @ b for a, b in pairwise(TOUR)])
    seen = TOUR[:count]
    steps = [a.inverse() @ b for a, b in pairwise(seen)]
    wrong = [Pose2.from_vector(rng.uniform(-4.0, 4.0, 3)) for _ in steps]
    assert is_shuffled(links(seen), piece("b", wrong), fixed)
    # The same room twice: all nodes agree how the one lies to the other.
    assert not is_shuffled(links(seen), piece("b", steps), fixed)
    # A robot in two rooms that look like two others, which lie to each other in another way.
    between = [*steps[: count // 2], TWIN, *steps[count // 2 + 1 :]]
    assert not is_shuffled(links(seen), piece("b", between), fixed)


def test_three_nodes_tell_nothing():
    few = TOUR[: LEAST_PLACED - 1]
    fixed = piece("a", [a.inverse() @ b for a, b in pairwise(TOUR)])
    assert not is_shuffled(links(few), piece("b", [TWIN] * (len(few) - 1)), fixed)
