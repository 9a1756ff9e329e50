"""Independent support: places counted by hand, chance against Monte Carlo, mostly false fleets."""

import math

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.independent_support import (
    ChanceSupport,
    Support,
    chances,
    crowds,
    neighbours,
    support_of,
)
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from synthetic.fleet import FleetSettings, draw_fleet
from synthetic.merge_rivals import error, joined_falsely, oracle
from tests.quick import first_quick

FLOOR = 12.0


def along(agent: str, places: list[tuple[float, float]]) -> Fragment:
    ids = [NodeId(agent, 1, k) for k in range(len(places))]
    steps = []
    for k in range(len(places) - 1):
        (x, y), (u, v) = places[k], places[k + 1]
        steps.append(RelativePose(ids[k], ids[k + 1], PoseGaussian(Pose2(u - x, v - y), 1e-6 * np.eye(3))))
    return Fragment(ids[0], solve_graph(ids[0], Pose2(*places[0]), steps), tuple(steps))


def test_neighbours_at_both_ends_count_as_one_place():
    """Three links between two places, one from the same place to another, and one apart."""
    a = along("a", [(0.0, 0.0), (0.7, 0.0), (1.4, 0.0), (8.0, 0.0)])
    b = along("b", [(0.0, 0.0), (0.7, 0.0), (1.4, 0.0), (9.0, 0.0)])
    ends = [(0, 0), (1, 1), (2, 2), (1, 3), (3, 3)]
    links = [Link(a.nodes[i], b.nodes[j], PoseGaussian(Pose2(), np.eye(3))) for i, j in ends]
    near = neighbours(links, a, b, 2.0)
    assert crowds(np.ones((5, 5), bool), near).tolist() == [3, 3, 3, 1, 1]
    assert crowds(np.eye(5, dtype=bool), near).tolist() == [1] * 5
    every, chance, nearly = np.ones((5, 5), bool), np.full((5, 5), 0.01), np.eye(5, dtype=bool)
    support = support_of([0, 1, 2, 4], np.ones(5, bool), every, near, chance, nearly)
    assert support.places == pytest.approx(2.0) and support.coincidence == pytest.approx(0.01)
    assert support.others.tolist() == [1]
    # Landmarks that occur at other places too do not count, on either side.
    telling = np.array([True, True, True, False, False])
    support = support_of([0, 1, 2, 4], telling, every, near, chance, nearly)
    assert support.places == pytest.approx(1.0) and support.others.tolist() == []
    # What places the two maps nearly as the set does is no false place.
    nearly[4, 3] = True
    support = support_of([0, 1, 2, 4], np.ones(5, bool), every, near, chance, nearly)
    assert support.places == pytest.approx(2.0) and support.others.tolist() == []


def test_chance_is_the_share_of_poses_by_which_a_loop_closes_as_well():
    rng = np.random.default_rng(1)
    square = along("a", [(0.0, 0.0), (FLOOR, 0.0), (FLOOR, FLOOR), (0.0, FLOOR)])
    root = np.array([[1.2, 0.0, 0.0], [0.3, 0.9, 0.0], [0.05, -0.02, 0.2]])
    covariance = root @ root.T
    limits = [-0.5 * FLOOR, -0.5 * FLOOR, -math.pi], [0.5 * FLOOR, 0.5 * FLOOR, math.pi]
    drawn = rng.uniform(*limits, (400_000, 3))
    distances2 = (drawn * np.linalg.solve(covariance, drawn.T).T).sum(axis=1)
    for reach2 in (1.0, 4.0, 9.0):
        result = chances(
            np.array([[reach2]]), np.array([[math.sqrt(np.linalg.det(covariance))]]), square, square
        )
        assert result[0, 0] == pytest.approx((distances2 < reach2).mean(), rel=0.05)


def test_the_number_of_chance_sets_agrees_with_the_prediction():
    """Pairs of false places that agree, against Monte Carlo."""
    rng = np.random.default_rng(2)
    n, coincidence = 12, 0.03
    false = ChanceSupport(40.0, np.array([60.0, 0.0, 0.0, 0.0]))
    drawn = rng.random((20_000, n)) < false.share
    pairs = np.triu(np.ones((n, n), bool), 1) & drawn[:, :, None] & drawn[:, None, :]
    count = (pairs & (rng.random(pairs.shape) < coincidence)).sum(axis=(1, 2)).mean()
    two = Support(np.array([1, 1]), np.ones(n - 2, np.int64), coincidence)
    assert two.by_chance(false) == pytest.approx(count, rel=0.05)


def test_links_of_false_places_agree_with_monte_carlo():
    """As if one more had been heard that brings one link, or with half the chance another one, and so on."""
    rng = np.random.default_rng(3)
    false = ChanceSupport(5.0, np.array([6.0, 3.0, 0.0, 1.0]))
    brought = np.where(
        rng.random((200_000, 3)) < 1 / 11,
        rng.geometric(0.5, (200_000, 3)),
        rng.choice([1, 2, 4], p=[0.6, 0.3, 0.1], size=(200_000, 3)),
    )
    for places, links in ((1, 2), (1, 5), (2, 3), (2, 6), (3, 4), (3, 9), (3, 3), (2, 1)):
        share = (brought[:, :places].sum(axis=1) >= links).mean()
        assert false.at_least_links(places, links) == pytest.approx(share, abs=0.003)
    # Two places that bring three links each are rarer than two that bring one each.
    pair = Support(np.array([1, 1]), np.ones(9, np.int64), 0.03)
    rich = Support(np.array([3, 3, 3, 3, 3, 3]), np.ones(9, np.int64), 0.03)
    assert rich.places == pytest.approx(pair.places)
    assert rich.by_chance(false) < 0.2 * pair.by_chance(false)


def test_a_pair_is_not_judged_by_itself():
    first = Support(np.array([1, 1, 1]), np.array([2, 2]), 0.1)
    second = Support(np.array([1]), np.array([1, 1, 1, 4, 4, 4, 4]), 0.1)
    every = ChanceSupport.of([first, second])
    assert every.true == 4.0 and every.count == 5.0
    without = every.without(ChanceSupport.of([first]))
    assert without.true == 1.0 and without.count == 4.0
    assert without.crowded(1) == 1.0 and without.crowded(4) == pytest.approx((1.0 + 0.125) / 5.0)
    assert every.without(every).share == 0.0


@pytest.mark.parametrize("alike", first_quick([4, 1], 1))
def test_fleets_with_90_percent_false_links_are_joined_correctly_or_not_at_all(alike: int):
    """Most are as good as with the true links known, and none is joined by false links alone."""
    good = 0
    for seed in range(3):
        fleet = draw_fleet(0.9, np.random.default_rng([seed, 9]), FleetSettings(most_alike=alike))
        merged = merge_maps(fleet.maps, fleet.links)
        assert not joined_falsely(merged, fleet)
        good += error(merged, fleet.truth) < 1.1 * error(oracle(fleet), fleet.truth)
    assert good >= 2
