"""Is the probability that a link carries the share of such links that are right?"""

import numpy as np
import pytest

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.link_probability import (
    link_probabilities,
    prior_odds,
    probability,
    standpoints,
)
from mapweave.merge.pose_graph.links import Link
from synthetic.maps import changes_of
from synthetic.world import room, take_map


def fleet(seed: int, false_share: float, links: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Four robots on tours through one hall, and links at random of which some are off by anything up to 4 m.

    Returns:
        The probability of each link, kept or refused, and whether it is right.
    """
    rng = np.random.default_rng(seed)
    hall = room(0, 0, 12, 8, 60, rng)
    maps: dict[MapId, HybridMap] = {}
    truth: dict[NodeId, Pose2] = {}
    for agent in "abcd":
        tour = [Pose2(*rng.uniform([2, 2, -3], [10, 6, 3]))]
        for _ in range(24):
            tour.append(tour[-1] @ Pose2(rng.uniform(0.3, 0.8), 0, rng.normal(0, 0.6)))
        nodes, edges = take_map(hall, MapId(agent, 1), tour, rng, sigma_xy=0.02, sigma_heading=0.01)
        maps[MapId(agent, 1)] = HybridMap(changes_of(nodes, edges))
        truth |= {node.id: stop for node, stop in zip(nodes, tour, strict=True)}
    ids = sorted(truth)
    pairs = [(a, b) for a in ids for b in ids if a < b and a.map != b.map]
    right: dict[tuple[NodeId, NodeId], bool] = {}
    collected = []
    for k in rng.permutation(len(pairs))[:links]:
        a, b = pairs[k]
        sigma = rng.uniform(0.02, 0.1)
        relative = truth[a].inverse() @ truth[b]
        right[a, b] = bool(rng.random() > false_share)
        if not right[a, b]:
            relative = relative @ Pose2(*rng.uniform([-4, -4, -3], [4, 4, 3]))
        mean = relative @ Pose2(*rng.normal(0, [sigma, sigma, sigma / 2]))
        evidence = {"inliers": float(rng.integers(12, 60)), "share": 0.6}
        collected.append(Link(a, b, PoseGaussian.from_sigmas(mean, sigma, sigma / 2), evidence=evidence))
    merged = merge_maps(maps, collected)
    text = dict(link_probabilities(merged))
    odds = prior_odds(merged)
    for refusal in merged.refused:
        if refusal.link is not None and refusal.edge is None:
            component = merged.component_of(refusal.a)
            factor = 0.0
            if component == merged.component_of(refusal.b) and component is not None:
                (point,) = standpoints([refusal.link], merged.graphs[component], kept=False)
                factor = point.log_factor
            text[refusal.pair] = probability(factor, odds)
    return np.array([text[pair] for pair in right]), np.array(list(right.values()))


@pytest.mark.parametrize("false_share", [0.2, 0.8])
def test_probabilities_are_those_that_links_have(false_share: float):
    both = [fleet(seed, false_share) for seed in (1, 2, 3)]
    lines, right = (np.concatenate(column) for column in zip(*both, strict=True))
    share = right.mean()
    # Against the base rate as the probability of each (Brier's score).
    assert ((lines - right) ** 2).mean() < 0.5 * share * (1.0 - share)
    assert abs(lines.mean() - share) < 0.1
    sure = (lines > 0.99) | (lines < 0.01)
    assert sure.mean() > 0.5
    assert ((lines > 0.5) == right)[sure].mean() > 0.98


def test_they_are_never_certain_and_grow_with_the_evidence():
    values = [probability(factor, 2.0) for factor in (-1e9, -3.0, 0.0, 3.0, 1e9)]
    assert values == sorted(values) and 0.0 < values[0] < values[-1] < 1.0
    assert values[2] == pytest.approx(2 / 3)
