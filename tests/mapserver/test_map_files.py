"""Map files: what opening one works out."""

from dataclasses import replace

import numpy as np

from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.merge.pose_graph import solved_graph
from mapweave.merge.pose_graph.merged_map import NodePoses
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.storage.map_file import pack_map_file
from tests.mapserver.stub_services import two_maps


def test_opening_a_map_solves_for_no_covariance_that_is_not_asked_for(monkeypatch):
    """Of a map of 20 000 nodes all of them took minutes, before the page or anything else was there."""
    content, before = map_file_of(two_maps()), two_maps().poses
    with monkeypatch.context() as patch:
        patch.setattr(PoseGraph, "_joint", None)
        merged = merged_of(content)
    assert merged.poses.keys() == before.keys()
    for node, placement in merged.poses.items():
        expected = before[node]
        assert placement.component == expected.component
        one, other = placement.merged_from_robot, expected.merged_from_robot
        assert np.abs(one.mean.vector - other.mean.vector).max() < 1e-3
        assert np.allclose(one.covariance, other.covariance, rtol=0.05, atol=1e-9)


def test_a_large_map_is_written_without_solving_for_each_node(monkeypatch):
    """20 000 nodes took two minutes; and the same map gives the same file, whatever was asked before."""
    merged = two_maps()
    expected = {node: merged.poses[node].merged_from_robot for node in merged.poses}
    monkeypatch.setattr(solved_graph, "FEW", 3)
    large = replace(merged, graphs=tuple(map(fresh, merged.graphs)))
    large = replace(large, poses=NodePoses(large.graphs))
    first = pack_map_file(map_file_of(large))
    large.poses[next(iter(large.poses))]
    assert pack_map_file(map_file_of(large)) == first
    monkeypatch.setattr(PoseGraph, "covariance", None)
    content = map_file_of(large)
    assert content.poses.keys() == expected.keys()
    for node, (number, pose) in content.poses.items():
        assert number == merged.component_of(node)
        assert np.array_equal(pose.mean.vector, expected[node].mean.vector)
        assert np.allclose(pose.covariance, expected[node].covariance, rtol=1e-6, atol=1e-12)


def fresh(graph: PoseGraph) -> PoseGraph:
    """The same, of which nothing has been asked yet."""
    return PoseGraph(graph.anchor, graph.nodes, graph.means, graph.information)
