"""What others have mapped, in the asking robot's own map: against the truth."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from mapweave.hybridmap.query import MAX_KNOWN, KnownAnswer, KnownRequest
from mapweave.mapserver.coverage import SharedCoverage
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.merged_map import MergedMap, Placement
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from synthetic.maps import changes_of, numbered
from synthetic.world import room, take_map

A, B, C = MapId("a", 1), MapId("b", 1), MapId("c", 1)


class Scene:
    """Two robots that share the middle one of three rooms, and one in a room of its own."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        world = room(0, 0, 5, 4, 500, rng) + room(5, 0, 5, 4, 700, rng) + room(10, 0, 5, 4, 500, rng)
        elsewhere = room(40, 0, 5, 4, 500, rng)
        self.truth: dict[NodeId, Pose2] = {}
        self.begin: dict[MapId, Pose2] = {}
        self.merger = Merger()
        for map_id, rooms, where in ((A, (0, 5), world), (B, (5, 10), world), (C, (40,), elsewhere)):
            stops = [Pose2(x + 2.2 + 0.1 * k, 1.8 + 0.05 * k, 0.9 * k) for x in rooms for k in range(7)]
            nodes, edges = take_map(where, map_id, stops, rng)
            self.truth |= {node.id: stop for node, stop in zip(nodes, stops, strict=True)}
            self.begin[map_id] = stops[0]
            for change in numbered(map_id, changes_of(nodes, edges)):
                self.merger.on_change(change)
        self.merged = self.merger.merged()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_others_views_are_where_they_truly_are(scene: Scene):
    answer = SharedCoverage(scene.merged).answer(A, (5.0, 0.0), 100.0)
    own = scene.merged.maps[A].nodes
    true = [scene.truth[n] for n in sorted(scene.truth) if n.map == B]
    assert len(answer.views) == len(true)
    for pose in true:
        # The own map drifts: answers are right near the nearest own node.
        beside = min(own.values(), key=lambda node: scene.truth[node.id].distance(pose))
        world_from_map = scene.truth[beside.id] @ beside.map_from_robot.mean.inverse()
        collected = [world_from_map @ Pose2(*view[:3]) for view in answer.views]
        nearest = min(collected, key=pose.distance)
        assert pose.distance(nearest) < 0.3
        assert abs(wrap_angle(nearest.heading - pose.heading)) < 0.2
    assert set(answer.views[:, 3]) == {np.float32(beside.camera.semi_aperture)}
    assert "14 of 14 views" in answer.reason


def test_only_near_views_are_returned_nearest_first(scene: Scene):
    everything = SharedCoverage(scene.merged).answer(A, (5.0, 0.0), 100.0).views
    away = np.hypot(everything[:, 0] - 5.0, everything[:, 1])
    assert (np.diff(away) >= 0).all()
    reach = float(np.median(away))
    near = SharedCoverage(scene.merged).answer(A, (5.0, 0.0), reach).views
    assert np.array_equal(near, everything[away <= reach])


def test_the_agent_of_an_isolated_map_gets_no_poses(scene: Scene):
    for asking, reason in ((C, "no other map is joined to c"), (MapId("d", 1), "is not in the merged map")):
        answer = SharedCoverage(scene.merged).answer(asking, (0.0, 0.0), 100.0)
        assert answer.views.shape == (0, 4)
        assert reason in answer.reason
    assert not SharedCoverage(MergedMap.empty()).answer(A, (0.0, 0.0), 9.0).views.size


def test_a_bent_map_is_aligned_at_its_nearest_node():
    """The own map drifted by a turn halfway, the merged map knows better: each view keeps to its side."""
    rng = np.random.default_rng(3)
    nodes, _ = take_map(room(0, 0, 5, 4, 300, rng), A, [Pose2(1.0 + k, 2.0) for k in range(3)], rng)
    other = replace(nodes[0], id=NodeId("b", 1, 1))
    turned = Pose2(9.0, 9.0, 2.0)
    own = [Pose2(0.0, 0.0, 0.0), Pose2(1.0, 0.0, 0.0), turned]
    nodes = [
        replace(n, map_from_robot=PoseGaussian(p, np.zeros((3, 3)))) for n, p in zip(nodes, own, strict=True)
    ]
    merged_own = [Pose2(0.0, 0.0, 0.0), Pose2(1.0, 0.0, 0.0), Pose2(2.0, 0.0, 0.0)]
    places = dict(zip([n.id for n in nodes], merged_own, strict=True)) | {other.id: Pose2(2.3, 0.1, 0.2)}
    poses = {n: Placement(0, PoseGaussian(p, np.zeros((3, 3)))) for n, p in places.items()}
    maps = {A: HybridMap(map(NodePut, nodes)), B: HybridMap([NodePut(other)])}
    merged = MergedMap(maps, (), (), (frozenset(places),), poses)
    ((x, y, heading, _),) = SharedCoverage(merged).answer(A, (9.0, 9.0), 1.0).views
    expected = turned @ Pose2(0.3, 0.1, 0.2)
    assert (x, y, heading) == pytest.approx((expected.x, expected.y, expected.heading))


def test_answers_fit_into_a_message(scene: Scene):
    views = np.zeros((MAX_KNOWN + 9, 4))
    views[:, 0] = np.arange(len(views))[::-1]

    class Many(SharedCoverage):
        def _views(self, *_: object) -> list[tuple[float, float, float, float]]:
            return [(float(x), 0.0, 0.0, 0.5) for x, *_ in views]

    one = MergedMap(scene.merged.maps, (), (), scene.merged.components[:1], scene.merged.poses)
    result: KnownAnswer = Many(one).answer(A, (0.0, 0.0), math.inf)
    assert result.views[:, 0].tolist() == list(range(MAX_KNOWN))


def test_the_server_answers_over_the_bus(scene: Scene, tmp_path):
    hub, keys = MemoryHub(), Keys("fleet")
    bus, asker = MemoryBus(hub), MemoryBus(hub)
    with MapServer(bus, keys, tmp_path / "s0.sqlite", "s0", schedule=LockstepSchedule()):
        (reply,) = asker.ask(keys.any_known(), encode(KnownRequest(A, 0.0, 0.0, 9.0)), 5.0)
        assert "map a.1 is not in the merged map" in decode(reply.payload, KnownAnswer).reason
        (reply,) = asker.ask(keys.any_known(), b"garbage", 5.0)
        assert "known request" in reply.error
    asker.close()
    bus.close()
