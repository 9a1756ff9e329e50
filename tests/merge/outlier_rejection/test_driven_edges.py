"""Drives among others' nodes open ways, move no node, and are dropped where the merged map denies them."""

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.routes import Router
from mapweave.merge.merging import merge_maps
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import verify
from synthetic.maps import changes_of, merger_of
from synthetic.world import room, take_map

A, B, GUEST = MapId("a", 1), MapId("b", 1), MapId("guest", 1)
SIGMAS = np.array([0.02, 0.02, 0.01])


class Scene:
    """Two robots that have mapped one room; a third has mapped nothing and drives through both maps."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        world = room(0, 0, 6, 4, 700, rng)
        self.truth: dict[NodeId, Pose2] = {}
        self.maps: dict[MapId, HybridMap] = {GUEST: HybridMap()}
        for map_id, y in ((A, 1.6), (B, 2.3)):
            stops = [Pose2(1.2 + 0.8 * k, y, 0.1 * k) for k in range(5)]
            nodes, edges = take_map(world, map_id, stops, rng)
            self.truth |= {node.id: stop for node, stop in zip(nodes, stops, strict=True)}
            self.maps[map_id] = HybridMap(changes_of(nodes, edges))
        self.a, self.b = (sorted(self.maps[map_id].nodes) for map_id in (A, B))

    def merged(self, linked: bool = True) -> MergedMap:
        nodes = [self.maps[map_id].nodes.values() for map_id in (A, B)]
        verdicts = [verify(i, j) for i in nodes[0] for j in nodes[1]] if linked else []
        return merge_maps(self.maps, [verdict for verdict in verdicts if isinstance(verdict, Link)])

    def drive(self, a: NodeId, b: NodeId, shift: float = 0.0, sigmas: np.ndarray = SIGMAS) -> EdgeId:
        """The guest notes that it got from a to b."""
        edge_id = EdgeId("guest", 1, 1 + len(self.maps[GUEST].edges))
        measured = PoseGaussian(self.truth[a].inverse() @ self.truth[b] @ Pose2(shift), np.diag(sigmas**2))
        evidence = {"there": 1.0, "back": 0.0, "inliers": 12.0}
        self.maps[GUEST].apply(EdgePut(Edge(edge_id, a, b, measured, EdgeKind.DRIVEN, evidence=evidence)))
        return edge_id


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_drive_from_map_to_map_opens_a_way_and_moves_no_node(scene: Scene):
    before = scene.merged()
    a, b = scene.a[0], scene.b[-1]
    assert [leg.kind for leg in Router(before).route(a, b).legs][1:] != [EdgeKind.DRIVEN]
    edge = scene.drive(a, b)
    after = scene.merged()
    assert not {refusal.edge for refusal in after.refused} - {None}
    assert edge in after.union().edges
    for node, place in before.poses.items():
        assert np.array_equal(
            place.merged_from_robot.mean.vector, after.poses[node].merged_from_robot.mean.vector
        )
    legs = Router(after).route(a, b).legs
    assert [(leg.node.id, leg.kind) for leg in legs] == [(a, None), (b, EdgeKind.DRIVEN)]
    back = Router(after).route(b, a).legs
    assert [(leg.node.id, leg.kind) for leg in back] == [(b, None), (a, EdgeKind.DRIVEN)]


def test_a_drive_that_the_merged_map_contradicts_is_left_out(scene: Scene):
    edge = scene.drive(scene.a[0], scene.b[-1], shift=1.0)
    merged = scene.merged()
    assert [r.reason for r in merged.refused if r.edge == edge] == ["a drive contradicts the merged map"]
    assert edge not in merged.union().edges


def test_a_drive_joins_no_maps(scene: Scene):
    """The merge knows no link between them: then no route may lead along the drive either."""
    edge = scene.drive(scene.a[0], scene.b[0])
    merged = scene.merged(linked=False)
    assert len(merged.components) == 2 and edge not in merged.union().edges
    answer = Router(merged).route(scene.a[0], scene.b[0])
    assert not answer.legs and "parts of the map that nothing joins" in answer.reason


def test_a_drive_to_a_node_that_is_gone_is_left_out(scene: Scene):
    edge = scene.drive(scene.a[0], scene.b[-1])
    scene.maps[B].apply(NodeRetired(scene.b[-1]))
    merged = scene.merged()
    assert [r.reason for r in merged.refused if r.edge == edge] == ["a drive leads to a node that is gone"]
    assert edge not in merged.union().edges


def test_the_server_still_compares_nodes_connected_by_a_drive(scene: Scene):
    """Neighbours on a robot's way are not compared, for they share its tracks; ends of a drive do not."""
    merger = merger_of({map_id: scene.maps[map_id].contents() for map_id in (A, B)})
    links = [link.pair for link in merger.merged().links]
    assert links
    for a, b in links:
        scene.drive(a, b)
    for change in scene.maps[GUEST].contents():
        merger.apply(GUEST, change)
    assert [link.pair for link in merger.merged().links] == links


@pytest.mark.parametrize("sigmas", [(100.0, 100.0, 3.0), (0.02, 0.02, 0.5), (1.0, 0.02, 0.01)])
def test_a_drive_that_measured_hardly_anything_opens_no_way(scene: Scene, sigmas: tuple[float, float, float]):
    """Nothing could contradict it: it would lead through walls."""
    a, b = scene.a[0], scene.b[-1]
    edge = scene.drive(a, b, 0.0, np.array(sigmas))
    merged = scene.merged()
    assert edge not in merged.union().edges
    assert [r.reason for r in merged.refused if r.edge == edge] == [
        "a drive measured no better than 0.6 m and 0.2 rad"
    ]
    assert all(leg.kind is not EdgeKind.DRIVEN for leg in Router(merged).route(a, b).legs)
