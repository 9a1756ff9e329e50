"""Wrong links: graduated non-convexity against brute force, cliques and both on synthetic fleets."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.links import Link
from synthetic.city import draw_grid
from synthetic.fleet import BARE, CAMERA, FleetSettings, draw_fleet
from synthetic.gnc import wrong_measurements
from synthetic.merge_rivals import RIVALS, error, oracle, precision_recall
from synthetic.pose_graph import batch_optimum, chi2_of, factors_of, split

GATE = 16.27
SMALL = FleetSettings(nodes=40, side=8.0)


def chi2(measurement: RelativePose, poses: dict[NodeId, Pose2]) -> float:
    relative = poses[measurement.a].inverse() @ poses[measurement.b]
    return replace(measurement.a_from_b, covariance=measurement.covariance).mahalanobis2(relative)


@pytest.mark.parametrize("seed", range(4))
def test_graduation_finds_the_cheapest_set_of_all(seed: int):
    """Truncated least squares by trying every set of links that may be left out."""
    rng = np.random.default_rng(seed)
    ids = [NodeId("a", 1, k) for k in range(10)]
    true = [Pose2(0.5 * k, np.sin(k), 0.3 * k) for k in range(10)]
    sigmas = np.array([0.03, 0.03, 0.01])

    def measured(i: int, j: int, robust: bool, off: Pose2) -> RelativePose:
        mean = true[i].inverse() @ true[j] @ off @ Pose2.from_vector(rng.normal(0, sigmas))
        return RelativePose(ids[i], ids[j], PoseGaussian(mean, np.diag(sigmas**2)), robust)

    way = [measured(k, k + 1, False, Pose2()) for k in range(9)]
    good = [measured(i, j, True, Pose2()) for i, j in ((0, 9), (1, 7), (2, 8))]
    bad = [measured(i, j, True, Pose2(*rng.uniform(0.6, 1.5, 2), 0.5)) for i, j in ((0, 5), (3, 9), (1, 8))]
    links = good + bad

    def cost(left_out: tuple[RelativePose, ...]) -> float:
        used = way + [m for m in links if m not in left_out]
        graph = solve_graph(ids[0], true[0], used)
        poses = {node: graph.pose(node) for node in graph.nodes}
        return sum(chi2(m, poses) for m in used) + GATE * len(left_out)

    sets = (some for size in range(7) for some in combinations(links, size))
    cheapest = min(sets, key=cost)
    result = wrong_measurements(ids[0], true[0], [*way, *links], GATE)
    assert {(m.a, m.b) for m in result} == {(m.a, m.b) for m in cheapest}


@pytest.mark.slow
def test_half_of_the_links_may_be_false():
    """Least squares alone is ruined; the others withstand. Not in every fleet."""
    names = ("least_squares", "gnc", "mapweave")
    ratios: dict[str, list[float]] = {name: [] for name in names}
    precisions: dict[str, list[float]] = {name: [] for name in names}
    for seed in range(3):
        fleet = draw_fleet(0.5, np.random.default_rng([seed, 1]), SMALL)
        best = error(oracle(fleet), fleet.truth)
        for name in names:
            merged = RIVALS[name](fleet.maps, fleet.links)
            if name == "mapweave":
                assert len(merged.links) + len(merged.refused) == len(fleet.links)
            ratios[name].append(error(merged, fleet.truth) / best)
            precisions[name].append(precision_recall(merged.links, fleet)[0])
    assert np.median(ratios["least_squares"]) > 3.0 and np.median(precisions["least_squares"]) == 0.5
    for name in names[1:]:
        assert np.median(ratios[name]) < 1.1 and np.median(precisions[name]) == 1.0


def test_too_few_links_between_two_maps_confirm_a_join_by_others():
    """One link from c to a and one to b: neither is enough alone, together and through a-b they are."""
    rng = np.random.default_rng(5)
    fleet = draw_fleet(0.0, rng, FleetSettings(robots=3, nodes=30, side=6.0, true_links=60))
    names = [tuple(sorted((link.a.agent, link.b.agent))) for link in fleet.links]
    between = {
        pair: [link for link, n in zip(fleet.links, names, strict=True) if n == pair] for pair in names
    }
    few = [*between["r0", "r1"], between["r0", "r2"][0], between["r1", "r2"][-1]]
    assert not set(few[-1].pair) & set(few[-2].pair)
    merged = merge_maps(fleet.maps, few)
    assert len(merged.components) == 1 and len(merged.links) == len(few)
    assert len(merge_maps(fleet.maps, few[:-1]).components) == 2
    again = merge_maps(dict(reversed(fleet.maps.items())), few[::-1])
    assert [link.pair for link in again.links] == [link.pair for link in merged.links]


@pytest.mark.parametrize("heading_sigma", [0.01, 0.1])
def test_links_that_are_all_right_end_at_the_batch_optimum(heading_sigma: float):
    """None is refused, and none held back: GTSAM's optimum of the whole graph."""
    graph = draw_grid(300, heading_sigma, np.random.default_rng([5, 0]))
    maps, links, nodes = split(graph, 2)
    merged = merge_maps(maps, links)
    assert len(merged.links) == len(links)
    assert chi2_of(factors_of(graph), merged, nodes) == pytest.approx(batch_optimum(graph), rel=1e-3)


@pytest.mark.parametrize("side", [10.0, 1000.0])
def test_many_links_of_one_place_make_no_refused_link_likelier(side: float):
    """They are dependent: a link that all of them contradict stays refused, however many they are.

    However large the floor is: there a false link would hardly be so near, but one that is badly measured is.
    """
    place = [Pose2(0.1 * k, 0.0, 0.0) for k in range(10)]
    maps = {
        MapId(agent, 1): _drive(agent, [*place, Pose2(side, 0.0, 0.0), Pose2(side, side, 0.0)])
        for agent in "ab"
    }

    def link(j: int, k: int) -> Link:
        between = PoseGaussian.from_sigmas(place[j].inverse() @ place[k], 0.01, 0.003)
        return Link(NodeId("a", 1, j), NodeId("b", 1, k), between)

    links = [link(j, k) for j in range(10) for k in range(10)]
    sigmas = np.array([0.06, 0.12, 0.03])
    # 4.6 standard deviations from where everything else has it: 99.9 % of right links are within four.
    off = Pose2.from_vector(sigmas * 4.6 / np.sqrt(3.0) * [1.0, -1.0, 1.0])
    wrong = replace(links[0], a_from_b=PoseGaussian(off, np.diag(sigmas**2)))
    merged = merge_maps(maps, [wrong, *links[1:]])
    assert [link.pair for link in merged.links] == [link.pair for link in links[1:]]


def _drive(agent: str, poses: list[Pose2]) -> HybridMap:
    """A map whose way is known to millimetres."""
    out = HybridMap()
    for k, pose in enumerate(poses):
        here = NodeId(agent, 1, k)
        out.apply(
            NodePut(Node(here, k * 1_000_000_000, PoseGaussian.from_sigmas(pose, 0.003, 0.001), CAMERA, BARE))
        )
        if k:
            step = PoseGaussian.from_sigmas(poses[k - 1].inverse() @ pose, 0.003, 0.001)
            edge_id = EdgeId(agent, 1, len(poses) + k)
            out.apply(EdgePut(Edge(edge_id, NodeId(agent, 1, k - 1), here, step, EdgeKind.MAPPED)))
    return out
