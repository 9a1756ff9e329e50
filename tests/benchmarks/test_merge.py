"""The merge benchmark: its fleets keep their word, and its scores and split graphs against what is known."""

import math

import gtsam
import numpy as np
import pytest

from benchmarks.merge.robots import kept_links
from mapweave.formats.g2o import G2oEdge, G2oGraph
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.merging import merge_maps
from synthetic.fleet import FleetSettings, draw_fleet
from synthetic.merge_rivals import RIVALS, error, oracle
from synthetic.pose_graph import batch_optimum, chi2_of, factors_of, split

SMALL = FleetSettings(robots=3, nodes=25, side=7.0, true_links=15)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8])
def test_links_are_true_and_false_as_requested(share: float):
    fleet = draw_fleet(share, np.random.default_rng(3), SMALL)
    assert 1.0 - len(fleet.true) / len(fleet.links) == pytest.approx(share, abs=0.02)
    assert len({link.pair for link in fleet.links}) == len(fleet.links)
    for link in fleet.links:
        true = fleet.truth[link.a].inverse() @ fleet.truth[link.b]
        assert (link.a_from_b.mean.distance(true) < 0.2) == (link.pair in fleet.true)


def test_a_robot_that_is_left_apart_counts():
    fleet = draw_fleet(0.0, np.random.default_rng(4), SMALL)
    apart = merge_maps(fleet.maps, [])
    assert len(apart.components) == 3
    assert error(apart, fleet.truth) > 5.0 * error(oracle(fleet), fleet.truth)


def test_a_split_graph_has_the_cost_of_the_whole():
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


def test_in_space_the_links_that_close_loops_are_kept(tmp_path):
    """Two robots on random ways in space; links that were planted false are left out."""
    rng = np.random.default_rng(6)
    poses = {}
    for first in ("a", "b"):
        here = gtsam.Pose3.Expmap(rng.normal(0, 1, 6))
        for k in range(12):
            poses[gtsam.symbol(first, k)] = here
            here = here.compose(gtsam.Pose3.Expmap(rng.normal(0, 0.5, 6)))
    information = " ".join(f"{v}" for v in np.diag([100.0] * 3 + [10000.0] * 3)[np.triu_indices(6)])

    def line(i: int, j: int, off: gtsam.Pose3) -> str:
        noise = gtsam.Pose3.Expmap(rng.normal(0, [0.01] * 3 + [0.1] * 3))
        measured = poses[i].inverse().compose(poses[j]).compose(off).compose(noise)
        q, t = measured.rotation().toQuaternion(), measured.translation()
        numbers = [*t, q.x(), q.y(), q.z(), q.w()]
        return f"EDGE_SE3:QUAT {i} {j} {' '.join(f'{v:.9f}' for v in numbers)} {information}"

    keys = sorted(poses)
    way = [line(i, i + 1, gtsam.Pose3()) for i in keys if i + 1 in poses]
    true = [(gtsam.symbol("a", k), gtsam.symbol("b", 11 - k)) for k in range(5)]
    false = [(gtsam.symbol("a", k), gtsam.symbol("b", k)) for k in range(6, 10)]
    links = [line(i, j, gtsam.Pose3()) for i, j in true]
    links += [line(i, j, gtsam.Pose3.Expmap(rng.normal(0, 2, 6))) for i, j in false]
    (tmp_path / "0.g2o").write_text("\n".join(way))
    (tmp_path / "1.g2o").write_text("\n".join(links))
    every, kept = kept_links(tmp_path)
    assert sorted(every) == sorted(true + false) and set(kept) <= set(true) and len(kept) >= 4
    with pytest.raises(InvalidFile, match="no g2o file"):
        kept_links(tmp_path / "nowhere")
