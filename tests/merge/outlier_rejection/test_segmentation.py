"""A robot's own loops and drives are claims: false ones are left out and said so, the only bridge stays."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.fragments import Fragment

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
A = MapId("a", 1)
STEP = np.array([0.006, 0.005, 0.006])
LOOP = np.array([0.02, 0.02, 0.01])


class Aisles:
    """A robot that goes up and down between shelves, 1.8 m from bay to bay, four times.

    Attributes:
        map: its map, the way alone at first.
        truth: of its nodes, by number.
    """

    def __init__(self, seed: int, missing: int | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        lane = [Pose2(0.6 * k, 0.0, 0.0) for k in range(12)] + [
            Pose2(6.6 - 0.6 * k, 0.4, np.pi) for k in range(12)
        ]
        self.truth = lane * 2
        self.map = HybridMap()
        self.ids = [NodeId("a", 1, k) for k in range(len(self.truth))]
        self.number = 1000
        pose = PoseGaussian(Pose2(), np.zeros((3, 3)))
        for k, node_id in enumerate(self.ids):
            if k:
                step = self.measure(k - 1, k, STEP)
                pose = pose @ step
                if k != missing:
                    self.put(k - 1, k, step, EdgeKind.MAPPED)
            self.map.apply(NodePut(Node(node_id, k * 10**9, pose, CAMERA, Landmarks.empty())))

    def measure(self, i: int, j: int, sigmas: np.ndarray, shift: float = 0.0) -> PoseGaussian:
        true = self.truth[i].inverse() @ Pose2(shift, 0, 0) @ self.truth[j]
        noise = Pose2.from_vector(self.rng.normal(0, sigmas))
        return PoseGaussian(true @ noise, np.diag(sigmas**2))

    def put(self, i: int, j: int, relative: PoseGaussian, kind: EdgeKind, inliers: int = 25) -> EdgeId:
        self.number += 1
        edge_id = EdgeId("a", 1, self.number)
        evidence = {"inliers": float(inliers)}
        self.map.apply(EdgePut(Edge(edge_id, self.ids[i], self.ids[j], relative, kind, evidence=evidence)))
        return edge_id

    def loop(self, i: int, j: int, shift: float = 0.0, inliers: int = 25) -> EdgeId:
        return self.put(i, j, self.measure(i, j, LOOP, shift), EdgeKind.LOOP, inliers)

    def drive(self, i: int, j: int, shift: float = 0.0) -> EdgeId:
        return self.put(i, j, self.measure(i, j, LOOP, shift), EdgeKind.DRIVEN)

    def error(self, fragment: Fragment) -> float:
        """RMS error of positions, held at the first node, m."""
        off = [
            (self.truth[0] @ fragment.graph.pose(node)).distance(self.truth[node.number])
            for node in fragment.nodes
        ]
        return float(np.mean(np.square(off))) ** 0.5


GOOD = [(2, 26), (6, 30), (9, 33), (14, 38), (19, 43), (22, 46)]


@pytest.mark.parametrize("seed", range(4))
def test_a_loop_closure_off_by_a_bay_is_left_out_with_a_reason(seed: int):
    aisles = Aisles(seed)
    true = [aisles.loop(i, j) for i, j in GOOD]
    [clean] = fragments_of({A: aisles.map})
    assert not clean.refused
    false = aisles.loop(8, 29, shift=1.8, inliers=60)
    [piece] = fragments_of({A: aisles.map})
    assert [r.edge for r in piece.refused] == [false]
    refusal = piece.refused[0]
    assert refusal.reason == "the robot's own loop contradicts the map's own way between its nodes"
    assert refusal.link is not None and refusal.link.a_from_b is aisles.map.edges[false].a_from_b
    assert np.array_equal(piece.graph.means, clean.graph.means)
    merged = merge_maps({A: aisles.map}, [])
    assert "own loop contradicts" in merged.explain(*refusal.pair)
    union = merged.union()
    assert false not in union.edges and set(true) <= set(union.edges)
    assert not union.edges_between(*refusal.pair)
    assert false in aisles.map.edges


@pytest.mark.parametrize("add", [Aisles.loop, Aisles.drive])
def test_good_loops_and_drives_bring_the_map_nearer_to_the_truth(add: Callable[[Aisles, int, int], EdgeId]):
    with_them, without = [], []
    for seed in range(6):
        aisles = Aisles(seed)
        without.append(aisles.error(fragments_of({A: aisles.map})[0]))
        for i, j in GOOD:
            add(aisles, i, j)
        [piece] = fragments_of({A: aisles.map})
        assert not piece.refused
        with_them.append(aisles.error(piece))
    assert np.mean(with_them) < 0.8 * np.mean(without)


def test_a_single_loop_that_agrees_is_enough():
    aisles = Aisles(1)
    aisles.loop(2, 26)
    [piece] = fragments_of({A: aisles.map})
    assert not piece.refused and sum(m.robust for m in piece.measurements) == 1


def test_a_loop_that_only_other_loops_contradict_is_left_out():
    """The drive alone is too uncertain; four loops that agree are not."""
    aisles = Aisles(2)
    for edge in list(aisles.map.edges.values()):
        loose = PoseGaussian(edge.a_from_b.mean, np.diag([0.2, 0.2, 0.1]) ** 2)
        aisles.map.apply(EdgePut(Edge(edge.id, edge.a, edge.b, loose, edge.kind)))
    for i, j in GOOD[:4]:
        aisles.loop(i, j)
    false = aisles.loop(7, 31, shift=1.8)
    [piece] = fragments_of({A: aisles.map})
    assert [r.edge for r in piece.refused] == [false]
    assert "own loop contradicts 4 links" in piece.refused[0].reason


def test_a_bridge_stays_up_after_any_message():
    aisles = Aisles(3, missing=24)
    assert len(fragments_of({A: aisles.map})) == 2
    aisles.loop(23, 24, shift=1.8, inliers=1)
    [piece] = fragments_of({A: aisles.map})
    assert not piece.refused and len(piece) == 48


def test_of_bridges_that_contradict_each_other_the_better_supported_stay():
    aisles = Aisles(3, missing=24)
    for i, j in GOOD[:3]:
        aisles.loop(i, j)
    false = aisles.loop(4, 28, shift=1.8, inliers=60)
    [piece] = fragments_of({A: aisles.map})
    assert [r.edge for r in piece.refused] == [false] and len(piece) == 48
    assert aisles.error(piece) < 0.3


@pytest.mark.parametrize(("i", "j"), [(8, 9), (4, 8), (8, 29)])
def test_a_drive_between_wrong_places_is_left_out_and_bends_nothing(i: int, j: int):
    """Also between neighbours on the map's own way, and no robot shall drive by it."""
    aisles = Aisles(1)
    for pair in GOOD:
        aisles.loop(*pair)
    [clean] = fragments_of({A: aisles.map})
    false = aisles.drive(i, j, shift=0.5)
    [piece] = fragments_of({A: aisles.map})
    assert [(r.edge, r.reason) for r in piece.refused] == [
        (false, "the robot's own drive contradicts the map's own way between its nodes")
    ]
    assert np.array_equal(piece.graph.means, clean.graph.means)
    assert false not in merge_maps({A: aisles.map}, []).union().edges


@pytest.mark.parametrize("driven_first", [True, False])
def test_an_edge_recognised_and_driven_counts_once(driven_first: bool):
    aisles = Aisles(1)
    put = [aisles.drive, aisles.loop] if driven_first else [aisles.loop, aisles.drive]
    both = {item(2, 26) for item in put}
    [piece] = fragments_of({A: aisles.map})
    assert not piece.refused and sum(m.robust for m in piece.measurements) == 1
    assert both <= set(merge_maps({A: aisles.map}, []).union().edges)


def test_where_both_are_refused_both_are_named():
    aisles = Aisles(1)
    false = {aisles.loop(8, 29, shift=1.8), aisles.drive(8, 29, shift=1.8)}
    [piece] = fragments_of({A: aisles.map})
    assert {r.edge for r in piece.refused} == false


def test_a_view_is_trusted_where_a_drive_contradicts_it():
    aisles = Aisles(1)
    seen, driven = aisles.loop(2, 26), aisles.drive(2, 26, shift=0.5)
    [piece] = fragments_of({A: aisles.map})
    [refusal] = piece.refused
    assert refusal.edge == driven and refusal.reason == f"contradicts what was recognised, see {seen}"
    assert sum(m.robust for m in piece.measurements) == 1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 8), st.integers(0, 4))
def test_no_set_of_loops_tears_a_map_apart_or_makes_it_depend_on_order(seed: int, loops: int, missing: int):
    """For any loop closures: connected nodes stay connected, and all closures are kept or named."""
    aisles = Aisles(seed, missing=12 * missing if missing else None)
    rng = np.random.default_rng(seed)
    made = [aisles.loop(20, 40, shift=float(rng.uniform(-3, 3)))]
    for _ in range(loops):
        i, j = sorted(int(k) for k in rng.choice(48, 2, replace=False))
        made.append(aisles.loop(i, j, shift=float(rng.choice([0.0, 0.0, 1.8, -0.9]))))
    pieces = fragments_of({A: aisles.map})
    assert sorted(len(p) for p in pieces) == sorted(len(c) for c in aisles.map.components())
    kept = sum(m.robust for p in pieces for m in p.measurements)
    named = [r.edge for p in pieces for r in p.refused]
    assert len(set(named)) == len(named) and set(named) <= set(made)
    assert kept + len(named) == len(made)
    again = fragments_of({A: HybridMap(backwards(aisles.map))})
    assert [p.name for p in again] == [p.name for p in pieces]
    for first, second in zip(pieces, again, strict=True):
        assert np.array_equal(first.graph.means, second.graph.means)
        assert [(r.edge, r.reason) for r in first.refused] == [(r.edge, r.reason) for r in second.refused]


def backwards(hybrid_map: HybridMap) -> list[NodePut | EdgePut]:
    nodes, edges = list(hybrid_map.nodes.values())[::-1], list(hybrid_map.edges.values())[::-1]
    return [*map(NodePut, nodes), *map(EdgePut, edges)]
