"""Merging step by step against merging anew, over random lives of fleets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.merge_fleets import FleetSettings, draw_fleet
from hybridmap.change import EdgePut, EdgeRetired, NodePut, NodeRetired
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Edge, EdgeId, EdgeKind, MapId, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.pose_arrays import compose_poses
from hybridmap.ruling import Ruling, Rulings
from merge.candidates import Pair
from merge.incremental import Islands
from merge.incremental_factors import Factors, RelaxSettings, relax
from merge.incremental_graph import WideGraph
from merge.incremental_steps import Steps, StepSettings
from merge.incremental_verdicts import Verdict, Verdicts
from merge.links import Link, RefusedLink
from merge.merged import MergedMap
from merge.merging import MergeSettings, merge_maps
from merge.posegraph import Measurement, PoseGraph
from merge.undoing import undo

SMALL = FleetSettings(robots=5, nodes=16, side=7.0, true_links=80, apart=6)

DENSE = FleetSettings(robots=4, nodes=30, side=4.0, true_links=200, apart=6)


class Life:
    """Maps that grow and change at random, and what is found of their pairs of nodes."""

    def __init__(self, seed: int, false_share: float, settings: FleetSettings = SMALL) -> None:
        self.rng = np.random.default_rng(seed)
        fleet = draw_fleet(false_share, self.rng, settings)
        self.bodies = {map_id: list(one.contents()) for map_id, one in fleet.maps.items()}
        for map_id in self.bodies:  # each node, then the edge that leads to it
            nodes = [b for b in self.bodies[map_id] if isinstance(b, NodePut)]
            edges = [b for b in self.bodies[map_id] if isinstance(b, EdgePut)]
            self.bodies[map_id] = [b for two in zip(nodes, [None, *edges], strict=True) for b in two if b]
        self.coming = {link.pair: link for link in fleet.links}
        self.truth = fleet.truth
        self.maps: dict[MapId, HybridMap] = {}
        self.known: dict[Pair, Verdict] = {}
        self.verdicts = Verdicts()
        self.touched: set[MapId] = set()
        self.rulings = Rulings()
        self.number = 0

    def there(self, pair: Pair) -> bool:
        return all(node.map in self.maps and node in self.maps[node.map].nodes for node in pair)

    def change(self, map_id: MapId, body: NodePut | EdgePut | NodeRetired | EdgeRetired) -> None:
        one = HybridMap(self.maps[map_id].contents()) if map_id in self.maps else HybridMap()
        one.apply(body)
        self.maps[map_id] = one
        self.touched.add(map_id)
        for pair in [pair for pair in self.known if not self.there(pair)]:
            self.tell(pair, None)

    def tell(self, pair: Pair, verdict: Verdict | None) -> None:
        if verdict is None:
            self.known.pop(pair, None)
            self.verdicts.drop(pair)
        else:
            self.known[pair] = verdict
            self.verdicts.put(pair, verdict)
        self.touched |= {pair[0].map, pair[1].map}

    def step(self, quiet: bool = False) -> None:
        """Something happens; most often the maps grow, always if it is quiet."""
        rng, what = self.rng, 0.0 if quiet else self.rng.random()
        open_ = [map_id for map_id, bodies in self.bodies.items() if bodies]
        known = list(self.known)
        if what < 0.7 and open_:
            map_id = open_[int(rng.integers(len(open_)))]
            for _ in range(min(4, len(self.bodies[map_id]))):
                self.change(map_id, self.bodies[map_id].pop(0))
            for pair in [pair for pair in self.coming if self.there(pair)]:
                self.tell(pair, self.coming.pop(pair))
        elif what < 0.78 and known:
            pair = known[int(rng.integers(len(known)))]
            self.tell(pair, RefusedLink(*pair, "looked again") if rng.random() < 0.5 else None)
        elif what < 0.86 and self.maps:
            map_id = sorted(self.maps)[int(rng.integers(len(self.maps)))]
            nodes = sorted(self.maps[map_id].nodes)
            if len(nodes) > 3:
                self.change(map_id, NodeRetired(nodes[int(rng.integers(len(nodes)))]))
        elif what < 0.94 and self.maps:
            self._loop()
        elif known:
            pair = known[int(rng.integers(len(known)))]
            ends = pair if rng.random() < 0.7 or pair[0].map == pair[1].map else (pair[0].map, pair[1].map)
            self.number += 1
            ruling = Ruling(ends, bool(rng.random() < 0.6), "anna", self.number)
            self.rulings = self.rulings + Rulings([ruling])

    def _loop(self) -> None:
        """A robot recognises a place of its own, or drives there, and may be mistaken."""
        rng = self.rng
        map_id = sorted(self.maps)[int(rng.integers(len(self.maps)))]
        nodes = sorted(self.maps[map_id].nodes)
        if len(nodes) < 4:
            return
        a, b = (nodes[k] for k in sorted(rng.choice(len(nodes), 2, replace=False)))
        off = Pose2.from_vector(rng.normal(0.0, 0.02 if rng.random() < 0.8 else 2.0, 3))
        a_from_b = PoseGaussian.from_sigmas(self.truth[a].inverse() @ self.truth[b] @ off, 0.03, 0.02)
        self.number += 1
        kind = EdgeKind.LOOP if rng.random() < 0.6 else EdgeKind.DRIVEN
        others = sorted(n for one in self.maps.values() for n in one.nodes if n.map != map_id)
        if kind is EdgeKind.DRIVEN and others and rng.random() < 0.5:
            b = others[int(rng.integers(len(others)))]
        edge = Edge(EdgeId(map_id.agent, 1, 1000 + self.number), a, b, a_from_b, kind)
        self.change(map_id, EdgePut(edge))

    def anew(self) -> MergedMap:
        links = [v for v in self.known.values() if isinstance(v, Link)]
        refused = [v for v in self.known.values() if isinstance(v, RefusedLink)]
        undone = undo(self.maps, links, self.rulings)
        return undone.completed(merge_maps(undone.maps, undone.links, [*refused, *undone.refused]))


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


def polished(merged: MergedMap, anew: MergedMap) -> dict[NodeId, Pose2]:
    """Where the merge made anew has the nodes, optimised further: GTSAM stops a little before."""
    found: dict[NodeId, Pose2] = {}
    for graph in merged.graphs:
        assert isinstance(graph, WideGraph)
        means = np.array([anew.pose(node).vector for node in graph.nodes])
        anchor = np.array([graph.rows[graph.anchor]])
        everything = np.arange(len(means))
        means, _ = relax(graph.factors, means, anchor, everything, graph.huber, RelaxSettings())
        found |= {node: Pose2.from_vector(mean) for node, mean in zip(graph.nodes, means, strict=True)}
    return found


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
