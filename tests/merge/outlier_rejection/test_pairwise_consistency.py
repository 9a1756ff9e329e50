"""Which links are kept: planted false links, similar rooms, cliques against brute force."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.explanation import ALIASED
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.outlier_rejection import pairwise_consistency
from mapweave.merge.outlier_rejection.max_clique import best_clique, independent_links
from mapweave.merge.outlier_rejection.pairwise_consistency import loop_distances2, sort_links
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link


def fragment(agent: str, tour: list[Pose2], rng: np.random.Generator, sigma: float = 0.02) -> Fragment:
    ids = [NodeId(agent, 1, k) for k in range(len(tour))]
    steps = []
    for k in range(len(tour) - 1):
        noise = Pose2.from_vector(rng.normal(0, [sigma, sigma, sigma / 2]))
        mean = tour[k].inverse() @ tour[k + 1] @ noise
        covariance = np.diag([sigma**2, sigma**2, sigma**2 / 4])
        steps.append(RelativePose(ids[k], ids[k + 1], PoseGaussian(mean, covariance)))
    return Fragment(ids[0], solve_graph(ids[0], Pose2(), steps), tuple(steps))


def link(
    a: Fragment, i: int, b: Fragment, j: int, relative: Pose2, rng: np.random.Generator, inliers: int = 20
) -> Link:
    sigmas = np.array([0.03, 0.03, 0.01])
    mean = relative @ Pose2.from_vector(rng.normal(0, sigmas))
    evidence = {"inliers": float(inliers), "share": 0.8}
    return Link(a.nodes[i], b.nodes[j], PoseGaussian(mean, np.diag(sigmas**2)), evidence=evidence)


class Two:
    """Two robots on two tours of the same rooms."""

    def __init__(self, seed: int, n: int = 12) -> None:
        self.rng = np.random.default_rng(seed)
        self.tour_a = [Pose2(0.8 * k, 0.3 * np.sin(k), 0.2 * np.cos(k)) for k in range(n)]
        self.tour_b = [Pose2(0.8 * k + 0.3, 0.5, 0.1 * np.sin(k)) for k in range(n)]
        self.a, self.b = fragment("a", self.tour_a, self.rng), fragment("b", self.tour_b, self.rng)

    def true_link(self, i: int, j: int, inliers: int = 20) -> Link:
        return link(self.a, i, self.b, j, self.tour_a[i].inverse() @ self.tour_b[j], self.rng, inliers)

    def false_link(self, i: int, j: int, inliers: int = 20) -> Link:
        wrong = Pose2(*self.rng.uniform([-1, -1, -0.5], [1, 1, 0.5]))
        return link(self.a, i, self.b, j, wrong, self.rng, inliers)

    def alike_room(self) -> list[Link]:
        """Links that take the room at b's nodes 8 to 10, 6.4 m on, for the room at a's nodes 0 to 2."""
        shift = Pose2(-6.4, 0, 0)
        return [
            link(self.a, k, self.b, k + 8, self.tour_a[k].inverse() @ shift @ self.tour_b[k + 8], self.rng)
            for k in range(3)
        ]


@pytest.mark.parametrize("false_ones", [0, 4, 12])
def test_planted_false_links_are_refused(false_ones: int):
    for seed in range(5):
        second = Two(seed)
        true = [second.true_link(k, k) for k in range(0, 12, 2)]
        false = []
        for _ in range(false_ones):
            i = int(second.rng.integers(12))
            false.append(second.false_link(i, (i + int(second.rng.integers(3, 9))) % 12))
        sorted_links = sort_links([*true, *false], second.a, second.b)
        kept = {first.pair for first in sorted_links.kept}
        assert not kept & ({first.pair for first in false} - {first.pair for first in true})
        assert len(kept & {first.pair for first in true}) >= 5
        assert all(first.reason for first in sorted_links.refused)


def test_loop_misclosures_are_calibrated(monkeypatch):
    monkeypatch.setattr(pairwise_consistency, "LOOP_FLOOR", 1e-8 * np.eye(3))
    values = []
    for seed in range(40):
        two = Two(seed)
        links = [two.true_link(1, 1), two.true_link(9, 8)]
        values.append(loop_distances2(links, two.a, two.b)[0, 1])
    assert 2.0 < np.mean(values) < 4.2


def test_an_aliased_room_is_refused_when_the_right_one_has_more_support():
    """Links between rooms that look alike agree with each other and are wrong."""
    second = Two(3)
    aliased = second.alike_room()
    # They really close loops with each other: only better support can show that they are wrong.
    assert (loop_distances2(aliased, second.a, second.b) < 11.34).mean() > 0.7
    right = [second.true_link(k, k) for k in range(0, 12, 2)]
    sorted_links = sort_links([*aliased, *right], second.a, second.b)
    kept = {first.pair for first in sorted_links.kept}
    assert len(kept) >= 5 and kept <= {first.pair for first in right}
    assert {first.pair for first in aliased} <= {
        first.pair for first in sorted_links.refused if "contradicts" in first.reason
    }


def test_two_sets_with_equal_support_are_both_refused():
    second = Two(4)
    aliased = second.alike_room()
    right = [second.true_link(k, k) for k in range(3)]
    sorted_links = sort_links([*aliased, *right], second.a, second.b)
    assert not sorted_links.kept
    assert len(sorted_links.refused) == 6 and all(
        "ambiguous" in first.reason for first in sorted_links.refused
    )


def test_one_place_with_many_links_is_rejected_if_another_contradicts_it():
    """A corner like another gave five links, the corridor that both came by four of half the weight."""
    second = Two(8, n=16)
    shift = Pose2(-8.0, 0.0, 0.0)
    corner = [(0, 10), (0, 11), (1, 10), (1, 11), (1, 12)]
    alike = [
        link(second.a, i, second.b, j, second.tour_a[i].inverse() @ shift @ second.tour_b[j], second.rng, 30)
        for i, j in corner
    ]
    true = [second.true_link(i, j, 15) for i, j in ((7, 7), (7, 8), (8, 7), (8, 8))]
    assert len(sort_links(alike, second.a, second.b).kept) == 5
    sorted_links = sort_links([*alike, *true], second.a, second.b)
    assert not sorted_links.kept and len(sorted_links.rivals) == 2
    assert all("with 1.0 and 1.0 independent places" in first.reason for first in sorted_links.refused)
    # One contradicting link is no other set; and two further places decide between the two.
    assert len(sort_links([*alike, true[0]], second.a, second.b).kept) == 5
    more = [second.true_link(k, k, 50) for k in (0, 1, 14, 15)]
    kept = {first.pair for first in sort_links([*alike, *true, *more], second.a, second.b).kept}
    assert kept == {first.pair for first in [*true, *more]}


def test_a_single_link_is_too_little_unless_overwhelming():
    two = Two(5)
    sorted_links = sort_links([two.true_link(2, 2)], two.a, two.b)
    assert not sorted_links.kept and "no 2 links that share no node agree" in sorted_links.refused[0].reason
    assert len(sort_links([two.true_link(2, 2, inliers=60)], two.a, two.b).kept) == 1


def test_links_at_one_node_count_as_one_place():
    two = Two(6)
    sorted_links = sort_links([two.true_link(2, 2), two.true_link(2, 3)], two.a, two.b)
    assert not sorted_links.kept
    assert independent_links([two.true_link(2, 2), two.true_link(2, 3)], 9) == 1
    assert independent_links([two.true_link(2, 2), two.true_link(2, 3), two.true_link(3, 2)], 9) == 2


def test_loops_within_a_map_must_agree_with_its_own_way():
    second = Two(7)
    a, tour = second.a, second.tour_a
    true = [link(a, i, a, j, tour[i].inverse() @ tour[j], second.rng) for i, j in ((0, 9), (2, 11), (1, 7))]
    false = link(a, 3, a, 10, Pose2(0.2, 0.1, 0.0), second.rng, inliers=90)
    sorted_links = sort_links([*true, false], a, a)
    assert {first.pair for first in sorted_links.kept} == {first.pair for first in true}
    assert "own way" in sorted_links.refused[0].reason


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 9), st.integers(0, 10**6))
def test_best_clique_against_brute_force(n: int, seed: int):
    rng = np.random.default_rng(seed)
    agree = np.triu(rng.random((n, n)) < 0.6, 1)
    agree = agree | agree.T
    weights = rng.integers(1, 30, n)
    best = max(
        int(weights[list(subset)].sum())
        for size in range(1, n + 1)
        for subset in combinations(range(n), size)
        if all(agree[i, j] for i, j in combinations(subset, 2))
    )
    clique = best_clique(agree, weights)
    assert all(agree[i, j] for i, j in combinations(clique, 2))
    assert weights[clique].sum() == best
    greedy = best_clique(agree, weights, exact=0)
    assert all(agree[i, j] for i, j in combinations(greedy, 2))
    assert weights[greedy].sum() >= weights.max()


def test_greedy_clique_finds_a_planted_one():
    rng = np.random.default_rng(2)
    agree = np.triu(rng.random((120, 120)) < 0.2, 1)
    planted = np.sort(rng.choice(120, 30, replace=False))
    agree[np.ix_(planted, planted)] = True
    agree = np.triu(agree, 1)
    agree = agree | agree.T
    assert set(planted) <= set(best_clique(agree, np.full(120, 20)))


def test_what_one_robot_shows_twice_takes_nothing_from_links_between_others():
    """Links of three robots that agree are sorted together; most landmarks of one robot's are aliased."""
    two = Two(9)
    joined = two.b.graph
    names = {node: NodeId("c", 1, node.number) if node.number >= 6 else node for node in joined.nodes}
    steps = [replace(step, a=names[step.a], b=names[step.b]) for step in two.b.measurements]
    two.b = Fragment(joined.anchor, solve_graph(joined.anchor, Pose2(), steps), tuple(steps))
    links = [two.true_link(k, k, inliers=22 if k < 6 else 60) for k in range(12)]
    aliased = [
        replace(one, evidence={**one.evidence, ALIASED: 50.0}) if one.b.agent == "c" else one for one in links
    ]
    assert {one.pair for one in sort_links(aliased, two.a, two.b).kept} == {one.pair for one in links}
    alone = sort_links([one for one in aliased if one.b.agent == "c"], two.a, two.b)
    assert not alone.kept and {"found at other places too" in r.reason for r in alone.refused} == {True}
