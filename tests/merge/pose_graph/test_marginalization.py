"""Marginal links against the exact marginal distribution, by dense linear algebra."""

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.merge.pose_graph import marginalization
from mapweave.merge.pose_graph.component import Component, solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.marginalization import LINKS, fused, is_marginal, marginal_links


def node(k: int) -> NodeId:
    return NodeId("r0", 1 + k // 5, k)


def drawn(rng: np.random.Generator, count: int, more: int) -> tuple[list[RelativePose], list[Pose2]]:
    """A way through a hall, and further measurements between nodes of it, with noise."""
    truth = [Pose2(*rng.uniform([0, 0, -3], [4, 4, 3])) for _ in range(count)]
    pairs = [(k, k + 1) for k in range(count - 1)]
    while len(pairs) < count - 1 + more:
        a, b = sorted(rng.choice(count, 2, replace=False).tolist())
        if (a, b) not in pairs:
            pairs.append((a, b))
    measured = []
    for a, b in pairs:
        sigmas = rng.uniform(0.005, 0.02, 3)
        off = Pose2.from_vector(rng.normal(0.0, sigmas))
        pose = PoseGaussian(truth[a].inverse() @ truth[b] @ off, np.diag(sigmas**2))
        measured.append(RelativePose(node(a), node(b), pose))
    return measured, truth


def as_measurements(links: list[Link]) -> list[RelativePose]:
    return [link.measurement for link in links]


def without(measured: list[RelativePose], removed: set[NodeId]) -> list[RelativePose]:
    return [m for m in measured if removed.isdisjoint((m.a, m.b))]


def information_of(graph: Component, removed: set[NodeId]) -> Array:
    """(3N, 3N) of the remaining nodes, dense, by the Schur complement."""
    whole = graph.information.toarray()
    keep = [k for k, one in enumerate(graph.nodes) if one not in removed]
    drop = [k for k, one in enumerate(graph.nodes) if one in removed]
    i, j = ([3 * k + c for k in some for c in range(3)] for some in (keep, drop))
    left: Array = whole[np.ix_(i, i)]
    if j:
        left -= whole[np.ix_(i, j)] @ np.linalg.solve(whole[np.ix_(j, j)], whole[np.ix_(j, i)])
    return left


def divergence(exact: Array, approximate: Array) -> float:
    """Kullback-Leibler, of Gaussians with one mean and these information matrices."""
    spread = np.linalg.inv(exact)
    logs = np.linalg.slogdet(exact)[1] - np.linalg.slogdet(approximate)[1]
    return 0.5 * float(np.trace(approximate @ spread) - len(exact) + logs)


def test_a_way_through_one_node_becomes_its_composition():
    """Three nodes in a row: the link of the outer two is exact."""
    rng = np.random.default_rng(1)
    measured, _ = drawn(rng, 3, 0)
    graph = solve_graph(node(0), Pose2(1.0, 2.0, 0.5), measured)
    (link,) = marginal_links(graph, {node(1)}, ())
    composed = measured[0].a_from_b @ measured[1].a_from_b
    assert link.pair == (node(0), node(2)) and is_marginal(link)
    assert link.a_from_b.mean.distance(composed.mean) < 1e-6
    assert link.a_from_b.covariance == pytest.approx(composed.covariance, rel=0.1, abs=4e-6)


def shifts(now: Component, before: Component) -> Array:
    """By how many standard deviations nodes have moved, but for the first."""
    poses = before.poses()
    return np.array([poses[one].mahalanobis2(now.pose(one)) ** 0.5 for one in now.nodes[1:]])


@pytest.mark.parametrize("seed", range(4))
def test_what_is_left_is_near_the_exact_marginal_distribution(seed: int, monkeypatch):
    measured, truth = drawn(np.random.default_rng(seed), 24, 60)
    removed = {node(k) for k in range(1, 24, 2)}
    graph = solve_graph(node(0), truth[0], measured)
    exact, lost = information_of(graph, removed), {}
    for count in (LINKS, 0):
        monkeypatch.setattr(marginalization, "LINKS", count)
        links = marginal_links(graph, removed, ())
        left = solve_graph(node(0), truth[0], [*without(measured, removed), *as_measurements(links)])
        lost[count] = divergence(exact, information_of(left, set()))
        if count:
            assert shifts(left, graph).max() < 0.7, "the optimum stays where it was"
        else:
            assert len(links) == 11, "a tree"
    assert lost[LINKS] < 0.5 and lost[LINKS] < 0.25 * lost[0], "nats; a tree alone loses several"


def test_later_removals_replace_the_links_of_earlier_ones():
    rng = np.random.default_rng(9)
    measured, truth = drawn(rng, 30, 80)
    graph = solve_graph(node(0), truth[0], measured)
    links: list[Link] = []
    gone: set[NodeId] = set()
    now = graph
    for first in (1, 2, 3):
        removed = {node(k) for k in range(first, 30, 4)}
        links = marginal_links(now, removed, links)
        gone |= removed
        assert not any(gone & {*link.pair} for link in links)
        assert len({link.pair for link in links}) == len(links)
        now = solve_graph(node(0), truth[0], [*without(measured, gone), *as_measurements(links)])
    assert set(now.nodes) == {node(k) for k in range(0, 30, 4)}
    assert shifts(now, graph).max() < 0.7
    mine, whole = (
        [part.poses()[one].covariance.trace() ** 0.5 for one in now.nodes[1:]] for part in (now, graph)
    )
    assert mine == pytest.approx(whole, rel=0.25), "and is known as well as before"


def test_nodes_far_from_a_removal_keep_their_links():
    rng = np.random.default_rng(2)
    measured, truth = drawn(rng, 40, 0)
    graph = solve_graph(node(0), truth[0], measured)
    links = marginal_links(graph, {node(3)}, ())
    now = solve_graph(node(0), truth[0], [*without(measured, {node(3)}), *as_measurements(links)])
    more = marginal_links(now, {node(30)}, links)
    assert len(more) == 2 and links[0] in more


def test_a_verified_link_and_a_marginal_one_count_both():
    near, far = (PoseGaussian.from_sigmas(Pose2(x, 0.0, 0.0), 0.02, 0.01) for x in (1.00, 1.02))
    marginal = Link(node(0), node(7), near, evidence={"marginal": 1.0})
    verified = Link(node(0), node(7), far, np.array([[1, 2]]), {"inliers": 30.0})
    both = fused(marginal, verified.turned())
    assert both is not None and is_marginal(both) and both.weight == 30 and both.shared.tolist() == [[1, 2]]
    solved = solve_graph(
        node(0), Pose2(), [RelativePose(node(0), node(7), near), RelativePose(node(0), node(7), far)]
    )
    assert both.a_from_b.mean.distance(solved.pose(node(7))) < 1e-6
    assert both.a_from_b.covariance == pytest.approx(solved.poses()[node(7)].covariance, rel=0.05, abs=2e-6)
    elsewhere = PoseGaussian.from_sigmas(Pose2(1.5, 0.0, 0.0), 0.02, 0.01)
    assert fused(marginal, Link(node(0), node(7), elsewhere)) is None
