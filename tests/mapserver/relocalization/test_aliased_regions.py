"""Two rooms that look the same, one of them not mapped from where the view was taken."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.mapserver.merge_worker import PREPARED_AT_ONCE, MergeWorker
from mapweave.mapserver.relocalization.alias_cache import AliasCache
from mapweave.mapserver.relocalization.aliased_landmarks import between
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegionSettings
from mapweave.mapserver.relocalization.candidates import RetrievedNodes
from mapweave.mapserver.relocalization.place_hypotheses import NodeMatch
from mapweave.mapserver.relocalization.relocalizer import RelocalizationSettings, Relocalizer
from mapweave.mapserver.relocalization.view_registration import Registration
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.retrieval.ranking import Ranked
from mapweave.mapserver.schedule import LiveSchedule, LockstepSchedule, Schedule
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.merged_map import MergedMap, Placement
from mapweave.registration.recognition import RecognitionSettings, recognise
from synthetic.world import room, take_node, take_view
from tests.waiting import eventually

ROOM = room(0, 0, 5, 4, 700, np.random.default_rng(1))
OTHER = room(0, 0, 5, 4, 700, np.random.default_rng(2))
STOP = Pose2(2.2, 2.0, 0.0)
AWAY = Pose2(30.0, 7.0, 0.8)
"""Where the second room is."""
SEEN = Pose2(0.0, 0.0, 0.3)
ASIDE = (Pose2(0.05, 0.0, 0.85), Pose2(0.0, 0.05, -0.25))
"""From the stop: where only one room was looked at, and where both were."""


def taken(number: int, at: Pose2, shift: Pose2, seed: int, agent: str = "r0", world=ROOM) -> Node:
    """A node whose map says that it lies in a room that is shifted."""
    pose = PoseGaussian.from_sigmas(shift @ at, 0.01, 0.01)
    return take_node(world, NodeId(agent, 1, number), at, pose, np.random.default_rng(seed))


def here_and_there(world=ROOM, agent: str = "r0") -> list[Node]:
    """The node that is recognised, its neighbours, and what was mapped of the second room."""
    observations = [SEEN, *ASIDE]
    here = [taken(1 + k, STOP @ look, Pose2(), 10 + k) for k, look in enumerate(observations)]
    there = [
        taken(4 + k, STOP @ look @ Pose2(0.06, 0.04, 0.05), AWAY, 20 + k, agent, world)
        for k, look in enumerate(ASIDE)
    ]
    return [*here, *there]


def joined(nodes: Sequence[Node]) -> MergedMap:
    """One map of them all, where each says that it is."""
    first, *others = nodes
    start = first.map_from_robot.mean
    ways = [PoseGaussian.from_sigmas(start.inverse() @ one.map_from_robot.mean, 0.01, 0.01) for one in others]
    measured = [RelativePose(first.id, one.id, way) for one, way in zip(others, ways, strict=True)]
    graph = solve_graph(first.id, start, measured)
    poses = {node: Placement(0, pose) for node, pose in graph.poses().items()}
    return MergedMap({}, (), (), (frozenset(poses),), poses, (graph,))


class OnlyTheFirst:
    """Finds one node for the view, as if nothing else looked like it, and for nodes what is really alike."""

    def __init__(self, nodes: Sequence[Node], view: View) -> None:
        self.index, self.view, self.first, self.asked = PlaceIndex(), view, nodes[0].id, 0
        self.index.extend(nodes)

    def query(self, view: View, k: int = 5) -> Ranked:
        if view is self.view:
            return Ranked([(self.first, 2.0)])
        self.asked += 1
        return self.index.query(view, k)


VIEW, _ = take_view(ROOM, STOP @ SEEN @ Pose2(0.04, 0.02, 0.03), np.random.default_rng(4))


def asked(nodes: Sequence[Node], merged: MergedMap, **regions: float) -> Relocalizer:
    settings = RelocalizationSettings(regions=AliasedRegionSettings(**regions))  # type: ignore[arg-type]
    by_id = {one.id: one for one in nodes}
    return Relocalizer(OnlyTheFirst(nodes, VIEW), by_id.get, merged, settings)


def test_neighbours_show_that_a_room_occurs_twice():
    nodes = here_and_there()
    merged = joined(nodes)
    assert asked(nodes, merged, least_nodes=0).answer(VIEW).certainty is Certainty.FOUND
    answer = asked(nodes, merged).answer(VIEW)
    assert answer.certainty is Certainty.AMBIGUOUS and "3 nodes around" in answer.reason
    here, there = answer.candidates
    assert here.node == nodes[0].id and there.node in {nodes[3].id, nodes[4].id}
    assert there.merged_from_robot is not None
    true = AWAY @ STOP @ SEEN @ Pose2(0.04, 0.02, 0.03)
    assert there.merged_from_robot.mean.distance(true) < 0.1
    assert there.merged_from_robot.mahalanobis2(true) < 16.3
    assert here.probability + there.probability < 1.0 + 1e-9


AROUND = (Pose2(0.0, 0.05, 1.55), Pose2(0.05, 0.0, -0.95), Pose2(0.0, 0.0, 2.8), Pose2(0.0, 0.05, -2.1))
"""From the stop: what shows nothing of what the view shows."""


def test_unobserved_places_are_no_evidence():
    """The nodes around have doubles, all in one direction; where the view's own would be there is none."""
    here = [taken(1 + k, STOP @ look, Pose2(), 10 + k) for k, look in enumerate([SEEN, *AROUND])]
    there = [
        taken(6 + k, STOP @ look @ Pose2(0.06, 0.04, 0.05), AWAY, 20 + k) for k, look in enumerate(AROUND)
    ]
    nodes = [*here, *there]
    answer = asked(nodes, joined(nodes)).answer(VIEW)
    assert answer.certainty is Certainty.AMBIGUOUS
    assert answer.candidates[1].node in {item.id for item in there}
    # A view of the same spot with other things decides; a view from elsewhere does not.
    for turn, result in ((0.0, Certainty.FOUND), (0.9, Certainty.AMBIGUOUS)):
        other = taken(19, STOP @ SEEN @ Pose2(0.05, 0.0, turn), AWAY, 30, world=OTHER)
        more = [*nodes, other]
        assert asked(more, joined(more)).answer(VIEW).certainty is result
    # One thing that is there twice says nothing of what lies beside it.
    thing = [
        replace(item, landmarks=item.landmarks.take(np.abs(item.landmarks.pixels[:, 0] - 160.0) < 35.0))
        for item in there
    ]
    few = [*here[:2], thing[0]]
    settings = {"least_nodes": 1, "least_around": 1}
    assert asked(few, joined(few), **settings).answer(VIEW).certainty is Certainty.FOUND
    few[-1] = there[0]
    assert asked(few, joined(few), **settings).answer(VIEW).certainty is Certainty.AMBIGUOUS
    assert asked(few, joined(few), least_nodes=1).answer(VIEW).certainty is Certainty.FOUND


def test_unique_landmarks_are_distinct():
    for nodes in (here_and_there(OTHER), here_and_there()[:3]):
        assert asked(nodes, joined(nodes)).answer(VIEW).certainty is Certainty.FOUND


def test_the_needed_share_of_nodes_is_a_setting():
    nodes = here_and_there()[:4]
    merged = joined(nodes)
    # The node that was recognised and one neighbour have a double, the same one.
    assert asked(nodes, merged, least_nodes=3).answer(VIEW).certainty is Certainty.FOUND
    assert (
        asked(nodes, merged, least_share=0.9, most_looked_at=-1.0).answer(VIEW).certainty is Certainty.FOUND
    )
    result = asked(nodes, merged, least_nodes=2, least_share=0.3).answer(VIEW)
    assert result.certainty is Certainty.AMBIGUOUS


def test_aliases_that_cannot_matter_are_not_searched():
    """No node has any, and one is left: a party needs two. Each search took 10 ms in a large fleet."""
    for nodes, searched in ((here_and_there()[:1], 0), (here_and_there()[:3], 2), (here_and_there(), 3)):
        service = asked(nodes, joined(nodes))
        for _ in range(2):
            answer = service.answer(VIEW)
            assert answer.certainty is (Certainty.AMBIGUOUS if len(nodes) == 5 else Certainty.FOUND)
            assert service._index.asked == searched
    # One that has just come is searched last, although it shows more of the view than those that are known.
    nodes = here_and_there()[:3]
    before = asked(nodes, joined(nodes))
    before.prepare(3)
    nodes.append(taken(9, STOP @ SEEN @ Pose2(0.02, 0.0, 0.02), Pose2(), 40))
    index = OnlyTheFirst(nodes, VIEW)
    later = Relocalizer(index, {one.id: one for one in nodes}.get, joined(nodes), alike=before.alike)
    assert later.answer(VIEW).certainty is Certainty.FOUND and index.asked == 0


def test_the_same_room_mapped_twice_is_one_place():
    nodes = here_and_there()
    twice = [
        replace(one, map_from_robot=PoseGaussian(AWAY.inverse() @ one.map_from_robot.mean, np.eye(3) * 1e-4))
        if k > 2
        else one
        for k, one in enumerate(nodes)
    ]
    assert asked(twice, joined(twice)).answer(VIEW).certainty is Certainty.FOUND


def concluded(
    service: Relocalizer, recognised: NodeMatch, ranked: list[tuple[NodeId, float]]
) -> RelocalizeAnswer:
    matches = service.registration.refined(VIEW, [recognised])
    return service.conclude(Registration(RetrievedNodes(VIEW, ranked), matches))


def test_maps_that_are_not_merged_have_their_own_frames():
    nodes = here_and_there(agent="r1")
    recognition = recognise(nodes[0], VIEW, None, np.random.default_rng(0))
    assert recognition is not None
    ranked = [(nodes[0].id, 2.0), (nodes[1].id, 0.1), (nodes[2].id, 0.1)]
    service = asked(nodes, MergedMap.empty())
    answer = concluded(service, NodeMatch(nodes[0].id, recognition), ranked)
    assert answer.certainty is Certainty.AMBIGUOUS and "nothing joins" in answer.reason
    assert answer.candidates[1].node.agent == "r1" and answer.candidates[1].merged_from_robot is None


def test_aliasing_is_cached_and_kept_up_to_date():
    nodes = here_and_there()
    merged, by_id = joined(nodes), {one.id: one for one in nodes}
    index, alike = OnlyTheFirst(nodes, VIEW), AliasCache(RecognitionSettings())

    def of(node: Node, known: MergedMap = merged) -> set[NodeId]:
        result = alike.of(node, index, by_id.get, lambda a, b: between(known, a, b))
        return {one.other.id for one in result}

    one, twin = nodes[1], nodes[3]
    assert of(one) == {twin.id} and of(one) == {twin.id} and index.asked == 1
    # Replaced by an equal node, as nodes that have lost landmarks are: it still holds.
    by_id[twin.id] = replace(twin, landmarks=twin.landmarks.take(np.arange(len(twin.landmarks))))
    assert of(replace(one)) == {twin.id} and index.asked == 1
    # A node that comes later is entered as soon as it is asked about itself.
    late = taken(9, STOP @ ASIDE[0] @ Pose2(0.0, 0.08, -0.04), AWAY @ Pose2(0, 50, 0), 31)
    by_id[late.id] = late
    index.index.add(late)
    assert of(late, MergedMap.empty()) >= {one.id, twin.id}
    assert of(one) == {twin.id, late.id} and index.asked == 2
    # Removed nodes are not searched, changed ones again.
    del by_id[late.id]
    assert of(one) == {twin.id}
    by_id[twin.id] = replace(twin, stamp_ns=twin.stamp_ns + 1)
    assert of(one) == set()
    assert of(replace(one, stamp_ns=7)) == {twin.id} and index.asked == 3


def test_a_merge_that_is_undone_is_noticed():
    nodes = here_and_there()
    again = taken(8, STOP @ ASIDE[0], Pose2(), 40)
    merged = joined([*nodes, again])
    index, alike = OnlyTheFirst([*nodes, again], VIEW), AliasCache(RecognitionSettings())
    by_id = {one.id: one for one in [*nodes, again]}
    for known, expected in ((merged, {nodes[3].id}), (MergedMap.empty(), {nodes[3].id, again.id})):
        result = alike.of(nodes[1], index, by_id.get, lambda a, b, known=known: between(known, a, b))
        assert {one.other.id for one in result} >= expected
        assert (again.id in {one.other.id for one in result}) == (again.id in expected)


def test_prepared_results_are_not_computed_again():
    nodes = here_and_there()
    service = asked(nodes, joined(nodes))
    index = service._index
    assert isinstance(index, OnlyTheFirst)
    assert [service.prepare(2) for _ in range(4)] == [3, 1, 0, 0]
    assert index.asked == 5
    assert service.answer(VIEW).certainty is Certainty.AMBIGUOUS
    assert index.asked == 5
    assert asked(nodes, joined(nodes), least_nodes=0).prepare(9) == 0


@pytest.mark.parametrize("schedule", [LiveSchedule, LockstepSchedule])
def test_a_server_evaluates_the_aliasing_of_nodes_in_advance(schedule: type[Schedule], monkeypatch):
    nodes, looked = here_and_there(), list[int]()

    def noted(service: Relocalizer, most: int) -> int:
        looked.append(most)
        return prepare(service, most)

    prepare = Relocalizer.prepare
    monkeypatch.setattr(Relocalizer, "prepare", noted)
    worker = MergeWorker(schedule(), 1.0)
    worker.start()
    for k, one in enumerate(nodes):
        worker.take(Change(one.id.map, k + 1, 0, NodePut(one)))
    assert worker.settle(20.0)
    eventually(lambda: all(worker._merger.alike.knows(one) for one in nodes))
    worker.close()
    assert max(looked) == PREPARED_AT_ONCE


def test_landmarks_without_depths_are_in_no_region():
    nodes = here_and_there()
    recognition = recognise(nodes[0], VIEW, None, np.random.default_rng(0))
    assert recognition is not None

    def without_depths(node: Node) -> Node:
        unknown = np.full_like(node.landmarks.depths, np.nan)
        return replace(node, landmarks=replace(node.landmarks, depths=unknown, depth_sigmas=unknown))

    found, ambiguous = Certainty.FOUND, Certainty.AMBIGUOUS
    for blind, result in (({0}, found), ({0, 1, 2}, found), ({1, 2}, ambiguous)):
        fewer = [without_depths(one) if k in blind else one for k, one in enumerate(nodes)]
        service = asked(fewer, joined(fewer))
        answer = concluded(service, NodeMatch(nodes[0].id, recognition), [(nodes[0].id, 2.0)])
        assert answer.certainty is result
