"""The solver against a batch optimum, while links come and go."""

import math

import numpy as np
import pytest

from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph import component
from mapweave.merge.pose_graph import component_solver as module
from mapweave.merge.pose_graph.component import Component, solve_graph
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from synthetic.fleet import FleetSettings, SyntheticFleet, draw_fleet

FLOOR = FleetSettings(robots=4, nodes=30, side=4.0, true_links=120, apart=6)


def drawn(seed: int) -> tuple[SyntheticFleet, list[Fragment], list[Link]]:
    fleet = draw_fleet(0.0, np.random.default_rng(seed), FLOOR)
    return fleet, fragments_of(fleet.maps), list(fleet.links)


def batch(fragments: list[Fragment], links: list[Link], graph: PoseGraph) -> Component:
    """GTSAM from along a tree, all at once."""
    measured = [m for f in fragments for m in f.measurements] + [link.measurement for link in links]
    inside = [m for m in measured if m.a in graph.rows]
    return solve_graph(graph.anchor, graph.pose(graph.anchor), inside)


@pytest.mark.parametrize("seed", [1, 2])
def test_links_that_come_and_go_leave_the_batch_optimum(seed: int):
    rng = np.random.default_rng(seed)
    _, fragments, links = drawn(seed)
    solver = ComponentSolver(fragments)
    for _ in range(12):
        some = [link for link in links if rng.random() < rng.choice([0.03, 0.5, 0.9])]
        graphs = solver.solve(some)
        assert sum(len(graph.nodes) for graph in graphs) == len(solver.by_node)
        for graph in graphs:
            own = solver.by_node[graph.anchor].graph.pose(graph.anchor)
            assert graph.pose(graph.anchor).distance(own) < 1e-9
            result = batch(fragments, some, graph)
            assert result.nodes == graph.nodes
            off = np.hypot(*(result.means - graph.means)[:, :2].T)
            assert off.max() < 2e-4


def test_an_untouched_island_is_the_same_object():
    _, fragments, links = drawn(3)
    solver = ComponentSolver(fragments)
    names = [fragment.name for fragment in fragments]
    first = [k for k in links if {k.a.map, k.b.map} == {names[0].map, names[1].map}]
    more = [k for k in links if {k.a.map, k.b.map} == {names[2].map, names[3].map}]
    assert len(first) > 1 and len(more) > 1
    before = {id(graph) for graph in solver.solve(first)}
    assert len(before) == 3
    after = solver.solve([*first, *more])
    assert len(after) == 2 and len({id(graph) for graph in after} & before) == 1
    assert {id(g) for g in solver.solve([*more, *first])} == {id(g) for g in after}, "in whatever order"


def test_it_goes_on_from_an_earlier_solution(monkeypatch):
    """Few nodes are moved at a time, and far-off ones stay; then all of them settle."""
    fleet, fragments, links = drawn(4)
    rng = np.random.default_rng(4)
    first = ComponentSolver(fragments)
    held = [link for link in links if rng.random() < 0.6]
    graphs = first.solve(held)
    monkeypatch.setattr(module, "WHOLE", 0)
    monkeypatch.setattr(module, "LEAST", 10)
    monkeypatch.setattr(module, "UNSETTLED", math.inf)
    second = ComponentSolver(fragments_of(fleet.maps))
    second.resume(graphs, fragments, held[:-1], held[-1:])
    new = [link for link in links if link not in held]
    near = second.solve([*held[:-1], *new])
    whole = second.solve([*held[:-1], *new], whole=True)
    assert len(near) == len(whole) == len(graphs)
    for a, b in zip(near, whole, strict=True):
        assert isinstance(a, Component) and isinstance(b, Component)
        assert a.unsettled > 0 and b.unsettled == 0
        assert np.abs(a.means - b.means)[:, :2].max() < 0.01
        result = batch(fragments, [*held[:-1], *new], b)
        assert np.abs(result.means - b.means)[:, :2].max() < 2e-4


def test_covariances_of_a_large_component_are_those_of_the_whole_or_larger(monkeypatch):
    _, fragments, links = drawn(5)
    graph = ComponentSolver(fragments).solve(links)[0]
    nodes = list(graph.nodes)
    starts, ends = nodes[:20], nodes[-20:]
    exact = graph.relative(starts, ends)
    monkeypatch.setattr(component, "EXACT", 0)
    monkeypatch.setattr(component, "MOST_EXACT", 0)
    relative = graph.relative(starts, ends)
    assert np.allclose(relative.covariances, exact.covariances, rtol=1e-4, atol=1e-9), "all are around"
    # With few nodes around a pair the rest of the graph is left out.
    monkeypatch.setattr(component, "NEARBY", 20)
    monkeypatch.setattr(component, "ROWS_AT_ONCE", 2)
    relative = graph.relative(starts, ends)
    assert np.allclose(relative.means, exact.means)
    larger = [
        np.linalg.eigvalsh(a - b)[0] for a, b in zip(relative.covariances, exact.covariances, strict=True)
    ]
    assert min(larger) > -1e-9
    assert np.abs(relative.covariances - exact.covariances).max() > 1e-6
