"""The pose graph against an independent least squares."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.sparse

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph import solved_graph
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import LEAST_SIGMAS, RelativePose
from mapweave.merge.pose_graph.marginal_covariances import marginal_covariances
from mapweave.merge.pose_graph.solved_graph import PoseGraph

IDS = [NodeId("a", 1, k) for k in range(8)]


def random_graph(seed: int, loops: int = 4) -> tuple[list[Pose2], list[RelativePose]]:
    rng = np.random.default_rng(seed)
    true = [Pose2(*rng.uniform([-5, -5, -3], [5, 5, 3])) for _ in IDS]
    pairs = [(k, k + 1) for k in range(7)] + [tuple(rng.choice(8, 2, replace=False)) for _ in range(loops)]
    measurements = []
    for i, j in pairs:
        sigmas = rng.uniform([0.02, 0.02, 0.01], [0.1, 0.1, 0.05])
        mean = true[i].inverse() @ true[j] @ Pose2.from_vector(rng.normal(0, sigmas))
        measurements.append(RelativePose(IDS[i], IDS[j], PoseGaussian(mean, np.diag(sigmas**2))))
    return true, measurements


def logarithm(pose: Pose2) -> np.ndarray:
    """(3,) the twist that leads to a pose in unit time: the residual that GTSAM minimises."""
    half = pose.heading / 2
    along = half / np.tan(half) if abs(half) > 1e-8 else 1.0
    return np.array([along * pose.x + half * pose.y, along * pose.y - half * pose.x, pose.heading])


def scipy_optimum(true: list[Pose2], measurements: list[RelativePose]) -> tuple[np.ndarray, np.ndarray]:
    """(8, 3) poses, and (8, 3, 3) covariances in the moving frames, with the first node held."""

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = [true[0], *(Pose2.from_vector(p) for p in x.reshape(-1, 3))]
        out = []
        for m in measurements:
            relative = poses[m.a.number].inverse() @ poses[m.b.number]
            d = logarithm(m.a_from_b.mean.inverse() @ relative)
            root = np.linalg.inv(np.linalg.cholesky(m.a_from_b.covariance + np.diag(LEAST_SIGMAS**2)))
            out.append(root @ d)
        return np.concatenate(out)

    start = np.concatenate([p.vector for p in true[1:]])
    optimum = scipy.optimize.least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    joint = np.linalg.inv(optimum.jac.T @ optimum.jac)
    means = np.vstack([true[0].vector, optimum.x.reshape(-1, 3)])
    covariances = np.zeros((8, 3, 3))
    for k in range(1, 8):
        turn = np.eye(3)
        turn[:2, :2] = Pose2.from_vector(means[k]).rotation
        block = joint[3 * k - 3 : 3 * k, 3 * k - 3 : 3 * k]
        covariances[k] = turn.T @ block @ turn
    return means, covariances


def test_optimum_and_covariances_against_scipy():
    for seed in range(4):
        true, measurements = random_graph(seed)
        graph = solve_graph(IDS[0], true[0], measurements)
        means, covariances = scipy_optimum(true, measurements)
        assert np.allclose(graph.means[:, :2], means[:, :2], atol=1e-4)
        assert np.allclose(np.sin(graph.means[:, 2] - means[:, 2]), 0, atol=1e-4)
        result = np.stack([graph.poses()[i].covariance for i in IDS])
        assert np.allclose(result, covariances, rtol=0.08, atol=2e-5)


def test_a_tree_is_solved_by_composition():
    true, measurements = random_graph(5, loops=0)
    graph = solve_graph(IDS[0], true[0], measurements)
    chained = PoseGaussian(true[0], np.zeros((3, 3)))
    for k in range(7):
        relative = PoseGaussian(measurements[k].a_from_b.mean, measurements[k].covariance)
        chained = chained @ relative
        pose = graph.poses()[IDS[k + 1]]
        assert pose.mean.distance(chained.mean) < 1e-9
        assert np.allclose(pose.covariance, chained.covariance, rtol=1e-4, atol=1e-8)


def test_relative_covariance_against_sampling_the_joint():
    true, measurements = random_graph(6)
    graph = solve_graph(IDS[0], true[0], measurements)
    rng = np.random.default_rng(1)
    i, j = 3, 6
    joint = graph.covariance([IDS[i], IDS[j]]).reshape(6, 6)
    samples = rng.multivariate_normal(np.zeros(6), joint, 20_000)
    a, b = graph.pose(IDS[i]), graph.pose(IDS[j])
    relative = (a.inverse() @ b).inverse()
    deviations = np.array(
        [
            (relative @ (a @ Pose2.from_vector(d[:3])).inverse() @ (b @ Pose2.from_vector(d[3:]))).vector
            for d in samples[:4000]
        ]
    )
    result = graph.relative([IDS[i]], [IDS[j]])
    assert np.allclose(np.cov(deviations.T), result.covariances[0], rtol=0.12, atol=2e-4)
    assert np.allclose(result.means[0][:2], (a.inverse() @ b).vector[:2])


def test_covariances_are_calibrated():
    distances = []
    for seed in range(40):
        true, measurements = random_graph(seed + 100)
        graph = solve_graph(IDS[0], true[0], measurements)
        distances.append(graph.poses()[IDS[7]].mahalanobis2(true[7]))
    assert 2.2 < np.mean(distances) < 3.9


def test_order_does_not_matter_and_unconnected_nodes_are_left_out():
    true, measurements = random_graph(8)
    apart = RelativePose(NodeId("z", 1, 1), NodeId("z", 1, 2), measurements[0].a_from_b)
    first = solve_graph(IDS[0], true[0], [*measurements, apart])
    second = solve_graph(IDS[0], true[0], [apart, *measurements[::-1]])
    assert first.nodes == second.nodes == tuple(IDS)
    assert np.array_equal(first.means, second.means)
    alone = solve_graph(IDS[3], true[3], [])
    assert alone.nodes == (IDS[3],)
    assert np.allclose(alone.means[0], true[3].vector)


def test_marginals_some_at_a_time_are_those_of_all_at_once(monkeypatch):
    true, measurements = random_graph(9)
    graph = solve_graph(IDS[0], true[0], measurements)
    joint = graph.covariance(graph.nodes)
    monkeypatch.setattr(solved_graph, "AT_ONCE", 3)
    result = graph.poses()
    assert list(result) == IDS
    for k, node in enumerate(IDS):
        assert np.allclose(result[node].covariance, joint[k, :, k, :], rtol=1e-9, atol=1e-14)
        assert np.array_equal(result[node].mean.vector, graph.means[k])


@pytest.mark.parametrize("loops", [0, 4, 60])
def test_marginals_of_a_large_graph_are_those_of_its_dense_inverse(loops: int, monkeypatch):
    """Of a large one they were solved for node by node, which took two minutes of 20 000 nodes."""
    rng = np.random.default_rng(loops)
    ids = [NodeId("a", 1, k) for k in range(60)]
    true = [Pose2(*rng.uniform([-9, -9, -3], [9, 9, 3])) for _ in ids]
    pairs = [(k, k + 1) for k in range(59)] + [tuple(rng.choice(60, 2, replace=False)) for _ in range(loops)]
    spread = PoseGaussian.from_sigmas(Pose2(), 0.05, 0.02).covariance
    steps = [
        RelativePose(ids[i], ids[j], PoseGaussian(true[i].inverse() @ true[j], spread)) for i, j in pairs
    ]
    graph = solve_graph(ids[30], true[30], steps)
    dense = np.linalg.inv(graph.information.toarray()).reshape(60, 3, 60, 3)
    monkeypatch.setattr(solved_graph, "FEW", 59)
    monkeypatch.setattr(PoseGraph, "covariance", None)
    result = graph.poses()
    assert list(result) == ids
    for k, node in enumerate(ids):
        assert np.allclose(result[node].covariance, dense[k, :, k, :], rtol=1e-6, atol=1e-14)
        assert np.array_equal(result[node].mean.vector, graph.means[k])


def test_marginals_of_nodes_that_nothing_joins():
    """Each has its own inverse; entries that are zero by chance change nothing."""
    rng = np.random.default_rng(4)
    own = np.array([one @ one.T + np.eye(3) for one in rng.normal(size=(4, 3, 3))])
    own[2] = np.diag([1.0, 2.0, 3.0])
    information = scipy.sparse.csc_matrix(scipy.linalg.block_diag(*own))
    assert np.allclose(marginal_covariances(information), np.linalg.inv(own))
    joined = information.toarray()
    joined[0, 9] = joined[9, 0] = joined[4, 8] = joined[8, 4] = 0.1
    expected = np.linalg.inv(joined).reshape(4, 3, 4, 3)[np.arange(4), :, np.arange(4)]
    assert np.allclose(marginal_covariances(scipy.sparse.csc_matrix(joined)), expected)


@pytest.mark.parametrize("seed", range(20))
def test_a_nearly_singular_covariance_still_makes_a_graph(seed: int):
    """Of any rank, with the greatest variance there is, and an eigenvalue that rounding made negative."""
    rng = np.random.default_rng(seed)
    measurements = []
    for k in range(7):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        covariance = axes * [1e4, 1e4 * rng.integers(0, 2), -3e-3 * rng.integers(0, 2)] @ axes.T
        step = PoseGaussian(Pose2(*rng.uniform(-5, 5, 3)), covariance)
        measurements.append(RelativePose(IDS[k], IDS[k + 1], step))
        assert np.linalg.eigvalsh(measurements[-1].covariance)[0] > 0.0
    graph = solve_graph(IDS[0], Pose2(), [*measurements, measurements[0]])
    assert all(np.isfinite(pose.covariance).all() for pose in graph.poses().values())
