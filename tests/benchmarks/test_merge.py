"""The merge benchmark: its fleets keep their word, and its scores and split graphs against what is known."""

import math

import numpy as np
import pytest

from mapweave.formats.g2o import G2oEdge, G2oGraph
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.merging import merge_maps
from synthetic.fleet import FleetSettings, draw_fleet
from synthetic.merge_rivals import RIVALS, error, oracle
from synthetic.pose_graph import batch_optimum, chi2_of, factors_of, split

SMALL = FleetSettings(robots=3, nodes=25, side=7.0, true_links=15)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8])
def test_links_are_true_and_false_as_requested(share: float) -> None:
    fleet = draw_fleet(share, np.random.default_rng(3), SMALL)
    assert 1.0 - len(fleet.true) / len(fleet.links) == pytest.approx(share, abs=0.02)
    assert len({link.pair for link in fleet.links}) == len(fleet.links)
    for link in fleet.links:
        true = fleet.truth[link.a].inverse() @ fleet.truth[link.b]
        assert (link.a_from_b.mean.distance(true) < 0.2) == (link.pair in fleet.true)


def test_a_robot_that_is_left_apart_counts() -> None:
    fleet = draw_fleet(0.0, np.random.default_rng(4), SMALL)
    apart = merge_maps(fleet.maps, [])
    assert len(apart.components) == 3
    assert error(apart, fleet.truth) > 5.0 * error(oracle(fleet), fleet.truth)


def test_a_split_graph_has_the_cost_of_the_whole() -> None:
    rng = np.random.default_rng(5)
    true = [Pose2(3.0 * math.cos(0.4 * k), 3.0 * math.sin(0.4 * k), 0.4 * k) for k in range(40)]
    sigmas = np.array([0.05, 0.05, 0.02])
    edges = []
    for i, j in [(k, k + 1) for k in range(39)] + [(k, k + 16) for k in range(0, 24, 2)]:
        mean = true[i].inverse() @ true[j] @ Pose2.from_vector(rng.normal(0, sigmas))
        edges.append(G2oEdge.measured(i, j, mean, np.diag(sigmas**2)))
    graph = G2oGraph(dict(enumerate(true)), edges)
    maps, links, nodes = split(graph, 4)
    assert len(links) == 12 + 3 and sum(len(hybrid_map.edges) for hybrid_map in maps.values()) == 36
    best = batch_optimum(graph)
    assert best < graph.chi2()
    for name in ("least_squares", "gnc", "mapweave"):
        chi2 = chi2_of(factors_of(graph), RIVALS[name](maps, links), nodes)
        assert chi2 == pytest.approx(best, rel=1e-3)
    assert chi2_of(factors_of(graph), merge_maps(maps, []), nodes) is None
