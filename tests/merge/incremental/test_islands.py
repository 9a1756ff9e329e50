"""Merging step by step against merging anew, over random lives of fleets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap.change import NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.recognising.pose_arrays import compose_poses
from merge.graph.merged import MergedMap
from merge.graph.posegraph import Measurement, PoseGraph
from merge.incremental.factors import Factors
from merge.incremental.graph import WideGraph
from merge.incremental.islands import Islands
from merge.incremental.relaxing import RelaxSettings
from merge.incremental.settings import StepSettings
from merge.incremental.steps import Steps
from merge.merging import MergeSettings
from tests.merge.lives import DENSE, Life, polished


def told(merged: MergedMap) -> tuple[object, ...]:
    """Everything but numbers."""
    return (
        [link.pair for link in merged.links],
        sorted((r.pair, r.reason, str(r.edge)) for r in merged.refused),
        set(merged.components),
        merged.rulings.in_force,
        set(merged.maps),
    )


@pytest.mark.parametrize(
    ("seed", "false_share"), [(0, 0.0), (1, 0.3), (2, 0.3), (3, 0.5), (4, 0.0), (5, 0.6)]
)
def test_islands_and_memory_change_nothing(seed: int, false_share: float) -> None:
    """Whatever happens in whatever order: the outcome is that of a merge made anew, to the last bit."""
    life, islands = Life(seed, false_share), Islands()
    for _ in range(45):
        life.step()
        if life.rng.random() < 0.4:
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
            life.touched = set()
            anew = life.anew()
            assert told(merged) == told(anew)
            assert [graph.anchor for graph in merged.graphs] == [graph.anchor for graph in anew.graphs]
            assert list(merged.postures) == list(anew.postures)
            for node, place in merged.postures.items():
                other = anew.postures[node]
                assert place.component == other.component
                assert place.merged_from_robot.mean == other.merged_from_robot.mean
                assert np.array_equal(place.merged_from_robot.covariance, other.merged_from_robot.covariance)
    assert len(islands.merge(life.maps, life.verdicts, set(), life.rulings).postures) > 20


@pytest.mark.parametrize(("seed", "false_share"), [(0, 0.0), (1, 0.3), (2, 0.5)])
def test_when_all_is_decided_again_steps_are_the_merge_made_anew(seed: int, false_share: float) -> None:
    """Another implementation with other covariances and another solver, and the same links and components."""
    life, islands = Life(seed, false_share), Islands(steps=StepSettings(anew_up_to=0, whole_share=-1.0))
    for _ in range(50):
        life.step()
        if life.rng.random() < 0.3:
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
            life.touched, anew = set(), life.anew()
            assert [link.pair for link in merged.links] == [link.pair for link in anew.links]
            assert set(merged.components) == set(anew.components)
            assert {(r.pair, r.edge) for r in merged.refused} == {(r.pair, r.edge) for r in anew.refused}
            for node, pose in polished(merged, anew).items():
                assert merged.pose(node).distance(pose) < 1e-6
                assert merged.pose(node).distance(anew.pose(node)) < 1e-4


@pytest.mark.parametrize("seed", [10, 11, 12])
def test_steps_of_growth_are_the_merge_made_anew(seed: int) -> None:
    """Nothing is ever decided again here, and little is moved at a time: links stand as if it were."""
    how = StepSettings(anew_up_to=0, whole_share=1e9, optimise_share=0.1, relax=RelaxSettings(least=12))
    life, islands = Life(seed, 0.0, DENSE), Islands(steps=how)
    for _ in range(60):
        life.step(quiet=True)
        merged = islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
        life.touched = set()
    anew = life.anew()
    assert set(merged.components) == set(anew.components)
    one, two = ({link.pair for link in links} for links in (merged.links, anew.links))
    # In eight fleets 0 to 3 of 200 links differed.
    assert len(two) > 150 and len(one ^ two) <= 0.03 * len(two)
    if one == two:
        assert max(merged.pose(node).distance(anew.pose(node)) for node in anew.postures) < 0.02


def test_all_is_decided_again_now_and_then_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """What deciding again makes anew is no change that calls for deciding again."""
    times: list[int] = []
    real = Steps._doubt_all
    monkeypatch.setattr(Steps, "_doubt_all", lambda *a: (times.append(1), real(*a))[1])
    life, islands = Life(4, 0.0, DENSE), Islands(steps=StepSettings(anew_up_to=0))
    for _ in range(40):
        life.step(quiet=True)
    islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
    assert len(times) >= 1
    times.clear()
    for _ in range(3):
        islands.merge(life.maps, life.verdicts, set(life.maps), life.rulings)
    assert not times


def test_covariances_of_a_wide_graph_are_those_of_the_whole_or_larger() -> None:
    life = Life(4, 0.0, DENSE)
    for _ in range(60):
        life.step(quiet=True)
    merged = Islands(steps=StepSettings(anew_up_to=0)).merge(
        life.maps, life.verdicts, life.touched, life.rulings
    )
    graph = merged.graphs[0]
    assert isinstance(graph, WideGraph) and len(graph.nodes) > 60
    nodes = list(graph.nodes)
    starts, ends = nodes[:20], nodes[-20:]
    exact = PoseGraph.relative(graph, starts, ends)
    assert np.allclose(graph.relative(starts, ends).covariances, exact.covariances, rtol=1e-4, atol=1e-9)
    # With few nodes around a pair the rest of the graph is left out.
    ends[0] = nodes[3]
    exact = PoseGraph.relative(graph, starts, ends)
    two = np.array([graph.rows[node] for node in (starts[0], ends[0])])
    near = np.sort(graph.factors.around(two, 20, len(nodes)))
    assert len(near) < len(nodes)
    part = graph.factors.take(
        np.flatnonzero(np.isin(graph.factors.a, near) & np.isin(graph.factors.b, near)),
        np.searchsorted(near, np.arange(len(nodes))),
    )
    few = WideGraph(nodes[near[0]], tuple(nodes[k] for k in near), graph.means[near], part, graph.huber)
    larger = few.relative([starts[0]], [ends[0]]).covariances[0] - exact.covariances[0]
    assert np.linalg.eigvalsh(larger)[0] > -1e-9
    with pytest.raises(ValueError, match="nothing joins"):
        replaced = part.take(np.zeros(0, np.int64), np.arange(len(near)))
        WideGraph(few.anchor, few.nodes, few.means, replaced, 2.0).relative([few.nodes[0]], [few.nodes[1]])


def test_measurements_pull_as_their_cost_falls() -> None:
    """Finite differences of the cost, with residuals that are not small."""
    rng = np.random.default_rng(3)
    poses = rng.normal(0.0, 1.0, (6, 3))
    covariance = np.diag([0.01, 0.02, 0.005])
    said = [
        Measurement(
            NodeId("a", 1, i), NodeId("a", 1, j),
            PoseGaussian(Pose2.from_vector(rng.normal(0.0, 0.7, 3)), covariance), bool(i % 2),
        )
        for i, j in [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 3), (1, 5)]
    ]  # fmt: skip
    factors = Factors.of(said, [m.a.number for m in said], [m.b.number for m in said])
    pull = factors.system(poses, 2.0)[1]
    for k in range(18):
        step = np.zeros(18)
        step[k] = 1e-6
        up, down = (compose_poses(poses, sign * step.reshape(6, 3)) for sign in (1.0, -1.0))
        slope = (factors.cost(up, 2.0) - factors.cost(down, 2.0)) / 2e-6
        assert -pull[k] == pytest.approx(slope, rel=1e-5, abs=1e-4)


def test_what_nothing_touches_is_kept() -> None:
    life, islands = Life(7, 0.0), Islands(MergeSettings())
    for _ in range(60):
        life.step()
    first = islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
    alone = MapId("z", 1)
    node = next(iter(life.maps[min(life.maps)].nodes.values()))
    life.maps[alone] = HybridMap([NodePut(replace(node, id=NodeId("z", 1, 1)))])
    second = islands.merge(life.maps, life.verdicts, {alone}, life.rulings)
    assert {id(g) for g in first.graphs} <= {id(g) for g in second.graphs}
    assert len(second.graphs) > len(first.graphs)
