"""What an implausible map measured moves no node of another map."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.component import Component, solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.staged_optimization import StagedOptimization
from synthetic.world import room, take_map

ODD = MapId("m", 1)
SIGMAS = 0.05, 0.02


def nodes_of(agent: str, count: int) -> list[NodeId]:
    return [NodeId(agent, 1, k + 1) for k in range(count)]


def measured(a: NodeId, b: NodeId, truth: dict[NodeId, Pose2], rng: np.random.Generator) -> RelativePose:
    way = truth[a].inverse() @ truth[b]
    noise = rng.normal(0.0, [SIGMAS[0], SIGMAS[0], SIGMAS[1]])
    return RelativePose(a, b, PoseGaussian.from_sigmas(way @ Pose2.from_vector(noise), *SIGMAS))


def drawn(seed: int, names: tuple[str, str, str], links: tuple[tuple[int, int], ...]) -> list[RelativePose]:
    """Drives of three robots, each from node to node, and links between those of the robots of each pair."""
    rng = np.random.default_rng(seed)
    drives = [nodes_of(name, 6) for name in names]
    truth = {
        node: Pose2.from_vector(rng.uniform([0, 0, -3], [6, 6, 3])) for nodes in drives for node in nodes
    }
    out = [measured(a, b, truth, rng) for nodes in drives for a, b in pairwise(nodes)]
    for first, second in links:
        out += [measured(drives[first][k], drives[second][k], truth, rng) for k in (0, 2, 5)]
    return out


def solved(measurements: list[RelativePose]) -> Component:
    anchor = min(node for m in measurements for node in (m.a, m.b))
    return solve_graph(anchor, Pose2(), measurements)


def map_with(node_id: NodeId, pose: Pose2) -> HybridMap:
    rng = np.random.default_rng(0)
    nodes, _ = take_map(room(0, 0, 5, 4, 50, rng), node_id.map, [pose], rng)
    out = HybridMap()
    out.apply(NodePut(replace(nodes[0], id=node_id, map_from_robot=PoseGaussian(pose, np.zeros((3, 3))))))
    return out


def merged_map(graph: Component) -> MergedMap:
    return MergedMap({}, (), (), (frozenset(graph.nodes),), NodePoses((graph,)), (graph,))


@pytest.mark.parametrize(
    "names", [("a", "b", "m"), ("n", "o", "m")], ids=["behind the others", "first of all"]
)
@pytest.mark.parametrize("seed", range(3))
def test_the_others_are_where_they_are_without_it(seed: int, names: tuple[str, str, str]):
    measurements = drawn(seed, names, ((0, 1), (0, 2), (1, 2)))
    graph = solved(measurements)
    alone = solved([m for m in measurements if ODD not in {m.a.map, m.b.map}])
    placed = StagedOptimization().solved(merged_map(graph), {ODD})
    assert placed.graphs[0].nodes == graph.nodes
    first = alone.nodes[0]

    def apart(one: MergedMap) -> float:
        return max(
            (alone.pose(first).inverse() @ alone.pose(node)).distance(
                one.pose(first).inverse() @ one.pose(node)
            )
            for node in alone.nodes
        )

    assert apart(merged_map(graph)) > 1e-3, "its measurements moved them"
    assert apart(placed) < 1e-6
    # And as certain as without it, not surer.
    ends = [first] * len(alone.nodes), list(alone.nodes)
    without, staged, together = (one.relative(*ends).covariances for one in (alone, placed.graphs[0], graph))
    assert np.allclose(staged, without, rtol=1e-4, atol=1e-9) and not np.allclose(
        together, without, rtol=1e-2
    )
    # Its own nodes lie where its links and its drive say, best of all places.
    cost = graph.factors
    means = placed.graphs[0].means

    def error(at: np.ndarray) -> float:
        total = 0.0
        for a, b, mean, weight in zip(cost.a, cost.b, cost.means, cost.weights, strict=True):
            way = Pose2.from_vector(at[a]).inverse() @ Pose2.from_vector(at[b])
            off = (Pose2.from_vector(mean).inverse() @ way).vector
            total += float(off @ weight @ off)
        return total

    own = [k for k, node in enumerate(graph.nodes) if node.map == ODD]
    rng = np.random.default_rng(seed)
    for _ in range(20):
        moved = means.copy()
        moved[own] += rng.normal(0.0, 1e-3, (len(own), 3))
        assert error(moved) > error(means)


@pytest.mark.parametrize("names", [("a", "b", "m"), ("n", "o", "m")], ids=["behind", "first of all"])
def test_what_it_alone_would_join_is_not_joined(names: tuple[str, str, str]):
    measurements = drawn(1, names, ((0, 2), (1, 2)))
    # One link more to the second.
    rng = np.random.default_rng(3)
    second, odd = NodeId(names[1], 1, 2), NodeId(*ODD, 2)
    measurements.append(measured(second, odd, {second: Pose2(1.0), odd: Pose2()}, rng))
    graph = solved(measurements)
    merged = merged_map(graph)
    frames = {node: Pose2(3.0, -1.0, 0.7) for node in (NodeId(names[0], 1, 1), NodeId(names[1], 1, 1))}
    maps = {node.map: map_with(node, frame) for node, frame in frames.items()}
    last = StagedOptimization()
    parted = last.solved(replace(merged, maps=maps), {ODD})
    assert [{node.agent for node in component} for component in parted.components] == [
        {names[1], "m"},
        {names[0]},
    ]
    for name in names[:2]:
        own = [m for m in measurements if m.a.agent == m.b.agent == name]
        alone, first = solved(own), NodeId(name, 1, 1)
        for node in alone.nodes:
            way = parted.pose(first).inverse() @ parted.pose(node)
            assert way.distance(alone.pose(first).inverse() @ alone.pose(node)) < 1e-6
    # What leaves the frame of its component's smallest node has the frame of its own smallest.
    moved = next(graph for graph in parted.graphs if solved(measurements).anchor not in graph.nodes)
    if moved.anchor in frames:
        assert moved.pose(moved.anchor).distance(frames[moved.anchor]) < 1e-12
    assert last.solved(replace(merged, maps=maps), {ODD}).graphs == parted.graphs


def test_what_did_not_change_is_the_same_object():
    merged, last = (
        merged_map(solved(drawn(1, ("a", "b", "m"), ((0, 1), (0, 2), (1, 2))))),
        StagedOptimization(),
    )
    assert last.solved(merged, set()) is merged and last.solved(merged, {MapId("x", 1)}) is merged
    once = last.solved(merged, {ODD}).graphs[0]
    assert once is not merged.graphs[0] and last.solved(merged, {ODD}).graphs[0] is once
    assert last.solved(merged, {ODD, MapId("a", 1), MapId("b", 1)}).graphs[0] is merged.graphs[0], (
        "no other is left"
    )
    assert last.solved(merged, {ODD}).graphs[0] is not once
