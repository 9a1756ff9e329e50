"""Poses relative to a node against networkx, and against the truth behind a loop that closes."""

import math
from dataclasses import replace
from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Edge, EdgeKind, HybridMap, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.mapping.relative_poses import LEVER, relative_poses, way_lengths
from synthetic.maps import changes_of
from synthetic.world import room, take_map

MAP = MapId("r0", 1)
RNG = np.random.default_rng(0)
PROTOTYPE: Node = take_map(room(0, 0, 5, 4, 50, RNG), MAP, [Pose2(1.0, 1.0)], RNG)[0][0]


def number(n: int) -> NodeId:
    return NodeId("r0", 1, n)


def map_of(count: int, edges: list[tuple[int, int, Pose2, float]]) -> HybridMap:
    """Nodes 0 to count - 1, and edges (a, b, a_from_b, sigma)."""
    nodes = [replace(PROTOTYPE, id=number(n)) for n in range(count)]
    made = [
        Edge(
            number(1000 + k),
            number(a),
            number(b),
            PoseGaussian.from_sigmas(pose, sigma, sigma),
            EdgeKind.LOOP,
        )
        for k, (a, b, pose, sigma) in enumerate(edges)
    ]
    return HybridMap(changes_of(nodes, made))


@st.composite
def graphs(draw: st.DrawFn) -> tuple[int, list[tuple[int, int, Pose2, float]]]:
    count = draw(st.integers(1, 8))
    number_of = st.integers(0, count - 1)
    pose = st.builds(Pose2, st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
    edge = st.tuples(number_of, number_of, pose, st.floats(0.01, 1.0)).filter(lambda e: e[0] != e[1])
    return count, draw(st.lists(edge, max_size=12, unique_by=lambda e: frozenset(e[:2])))


@given(graphs())
@settings(max_examples=60, deadline=None)
def test_poses_lie_along_the_most_certain_way(graph):
    count, edges = graph
    ways = nx.DiGraph()
    ways.add_nodes_from(range(count))
    for a, b, pose, sigma in edges:
        there = PoseGaussian.from_sigmas(pose, sigma, sigma)
        for start, end, way in ((a, b, there), (b, a, there.inverse())):
            c = way.covariance
            ways.add_edge(start, end, weight=c[0, 0] + c[1, 1] + LEVER**2 * c[2, 2], mean=way.mean)
    found = relative_poses(map_of(count, edges), number(0))
    lengths, paths = nx.single_source_dijkstra(ways, 0)
    assert set(found) == {number(n) for n in lengths}
    for n, path in paths.items():
        pose = Pose2()
        for a, b in pairwise(path):
            pose = pose @ ways.edges[a, b]["mean"]
        assert np.allclose(found[number(n)].vector[:2], pose.vector[:2], atol=1e-9)


@given(graphs())
@settings(max_examples=40, deadline=None)
def test_ways_are_the_shortest(graph):
    count, edges = graph
    ways = nx.Graph()
    ways.add_nodes_from(range(count))
    ways.add_edges_from((a, b, {"weight": math.hypot(pose.x, pose.y)}) for a, b, pose, _ in edges)
    expected = nx.single_source_dijkstra_path_length(ways, 0)
    found = way_lengths(map_of(count, edges), number(0))
    assert found == {number(n): pytest.approx(length) for n, length in expected.items()}


def test_what_lies_near_over_a_loop_closure_is_as_near_as_it_says():
    """Around a square of 10 m with 1 degree of drift an edge, and one loop closure at its end."""
    steps = [Pose2(1.0, 0.0, math.radians(1.0) + (math.pi / 2 if k % 10 == 9 else 0.0)) for k in range(39)]
    true = [Pose2()]
    for k in range(39):
        true.append(true[-1] @ Pose2(1.0, 0.0, math.pi / 2 if k % 10 == 9 else 0.0))
    edges = [(k, k + 1, step, 0.02) for k, step in enumerate(steps)]
    drifting = relative_poses(map_of(40, edges), number(39))
    edges.append((0, 39, true[39], 0.02))
    closed = relative_poses(map_of(40, edges), number(39))
    for n in range(6):
        truth = true[39].inverse() @ true[n]
        assert closed[number(n)].distance(truth) < 0.3
        assert drifting[number(n)].distance(truth) > 3.0


def test_nodes_that_no_edge_reaches_have_no_pose():
    assert relative_poses(map_of(3, [(0, 1, Pose2(1.0), 0.1)]), number(0)).keys() == {number(0), number(1)}
