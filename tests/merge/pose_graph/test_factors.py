"""The pose graph's columns against matrices of the group and finite differences of them."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.merge.pose_graph.factors import Factors, RelativePose

NODES = 6


def matrix(pose: Array) -> Array:
    """(3, 3) of a pose [x m, y m, heading rad]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def vector(motion: Array) -> Array:
    """(3,) m, m, rad of a matrix."""
    return np.array([motion[0, 2], motion[1, 2], math.atan2(motion[1, 0], motion[0, 0])])


def drawn(seed: int) -> tuple[Array, list[RelativePose]]:
    """(N, 3) poses, and measurements between them that are nearly right."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0.0, 1.0, (NODES, 3))
    measurements = []
    for a in range(NODES):
        for b in range(a + 1, NODES):
            root = 0.1 * rng.normal(0.0, 1.0, (3, 3))
            off = matrix(rng.normal(0.0, 1e-5, 3))
            between = vector(np.linalg.inv(matrix(means[a])) @ matrix(means[b]) @ off)
            text = PoseGaussian(Pose2.from_vector(between), root @ root.T + 0.01 * np.eye(3))
            measurements.append(RelativePose(NodeId("a", 1, a), NodeId("a", 1, b), text, bool((a + b) % 2)))
    return means, measurements


def factors_of(measurements: list[RelativePose]) -> Factors:
    return Factors.of(measurements, [m.a.number for m in measurements], [m.b.number for m in measurements])


def residual(m: RelativePose, a: Array, b: Array) -> Array:
    measured = matrix(m.a_from_b.mean.vector)
    return vector(np.linalg.inv(measured) @ np.linalg.inv(matrix(a)) @ matrix(b))


@pytest.mark.parametrize("seed", range(3))
def test_information_is_that_of_finite_differences(seed: int):
    """To first order in the residuals, so they are small here."""
    means, measurements = drawn(seed)
    held, precision = np.array([seed, NODES - 1]), 50.0
    result = factors_of(measurements).information(means, held, precision).toarray()
    expected = precision * np.diag(np.isin(np.arange(NODES), held).repeat(3).astype(np.float64))
    for m in measurements:
        i, j, step = m.a.number, m.b.number, 1e-5
        weight = np.linalg.inv(m.covariance)
        slopes = np.zeros((3, 3 * NODES))
        for k in range(3):
            move = matrix(step * np.eye(3)[k])
            back = matrix(-step * np.eye(3)[k])
            for row, ends in ((i, 0), (j, 1)):
                poses = [[means[i], means[j]] for _ in range(2)]
                poses[0][ends] = vector(matrix(means[row]) @ move)
                poses[1][ends] = vector(matrix(means[row]) @ back)
                slopes[:, 3 * row + k] = (residual(m, *poses[0]) - residual(m, *poses[1])) / (2 * step)
        expected += slopes.T @ weight @ slopes
    assert np.allclose(result, expected, atol=2e-3 * np.abs(expected).max())


def test_neighbours_are_found_ring_by_ring():
    """Along a chain of ten nodes, from its middle."""
    step = PoseGaussian(Pose2(1.0, 0.0, 0.0), np.eye(3))
    ids = [NodeId("a", 1, k) for k in range(10)]
    chain = factors_of([RelativePose(a, b, step) for a, b in pairwise(ids)])
    assert sorted(chain.around(np.array([5]), 1, 10)) == [5]
    assert sorted(chain.around(np.array([5]), 4, 10)) == [3, 4, 5, 6, 7]
    assert sorted(chain.around(np.array([0]), 99, 10)) == list(range(10))
    assert chain.at(np.array([3, 4])).tolist() == [2, 3, 4]
