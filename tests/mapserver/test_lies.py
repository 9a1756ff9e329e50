"""One robot of three lies: the other two keep their map and their answers, and the page says who it is."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import Linked, RetiredMap
from mapweave.hybridmap.edge_limits import unmeasurable
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_NUMBER
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import MapEventKind
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.plausibility import MOST_FRAGMENTS, unreliable_robots
from mapweave.merge.mutual_exclusion.trajectories import trajectories_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.staged_optimization import ALONE, BORNE_OUT
from mapweave.wire.codec import decode_change
from mapweave.wire.log_messages import Head
from mapweave.wire.messages import encode
from synthetic.maps import changes_of
from synthetic.world import room, take_map
from tests.mapserver.driven_maps import take_in
from tests.mapserver.false_maps import FIRST, LAST, STEP, copies, driven, views
from tests.mapserver.test_set_apart import (
    KEYS,
    TOUR,
    WORLD,
    Fleet,
    messages,
    serving,
    sound_logs,
    stored,
    whereabouts,
)
from tests.mapserver.test_set_apart import views as lost
from tests.quick import first_quick
from tests.waiting import eventually


def sound_merger() -> Merger:
    """With what the two sound robots have sent."""
    merger = Merger()
    for log in sound_logs().values():
        for message in log:
            merger.on_change(decode_change(message))
    return merger


def certainties(merger: Merger, merged: MergedMap) -> list[Certainty]:
    """Of the answers to lost robots."""
    relocalizer = Answers.of(merger, merged, merger.node).relocalizer
    return [relocalizer.answer(view).certainty for view in lost()]


def most_moved(before: MergedMap, after: MergedMap) -> float:
    """The farthest that another map has moved a node, seen from the first one of its component, m."""
    return max(
        (before.pose(first).inverse() @ before.pose(node)).distance(
            after.pose(first).inverse() @ after.pose(node)
        )
        for component in before.components
        for first in [min(component)]
        for node in component
    )


def backwards(bodies: list[ChangeBody], clock: str = "utc") -> list[ChangeBody]:
    """Of a robot whose clock runs backwards."""
    return [
        NodePut(replace(body.node, stamp_ns=10**12 - body.node.stamp_ns, clock=clock))
        if isinstance(body, NodePut)
        else body
        for body in bodies
    ]


def lies(map_id: MapId) -> dict[str, tuple[list[ChangeBody], str]]:
    """What is sent, and what is said against it."""
    vague, true = (views(map_id, Pose2(), spread) for spread in (9e3 * np.eye(3), STEP))
    nodes = backwards([body for body in true if isinstance(body, NodePut)])
    return {
        "copies": (copies(map_id), f"map {map_id} is set apart: "),
        "vague edges": (vague, f"map {map_id} is implausible: change 3 is refused (edge "),
        "a clock": (nodes, f"map {map_id} is implausible: its clock utc runs backwards"),
    }


def said(fleet: Fleet, words: str) -> list[MapEventKind]:
    return [event.kind for event in fleet.server.history() if event.words.startswith(words)]


@pytest.mark.parametrize(
    ("name", "map_id"), [("copies", FIRST), ("copies", LAST), ("vague edges", LAST), ("a clock", FIRST)]
)
def test_the_others_keep_their_map_and_their_answers(name: str, map_id: MapId, tmp_path):
    path = tmp_path / "s0.sqlite"
    stored(path, sound_logs()).close()
    log, words = lies(map_id)[name]
    status = AgentStatus(Status("mapping", "", 4, 0, Pose2(), False), 1, map_id.agent, 1)
    with serving(path) as fleet:
        links, places = sound_links(fleet), [where[0] for where in whereabouts(fleet.where())]
        assert links and set(places) == {Certainty.FOUND}
        fleet.acks_of(map_id.agent)
        fleet.tell(map_id, messages(map_id, log))
        assert fleet.server.settle(30)
        assert said(fleet, words), [event.words for event in fleet.server.history()]
        assert sound_links(fleet) == links
        assert [where[0] for where in whereabouts(fleet.where())] == places
        fleet.bus.publish(KEYS.agent_status(map_id.agent), encode(status))
        eventually(lambda: fleet.server.robots().robots)
        assert fleet.server.robots().robots[0].accusation.startswith(words)
    with serving(path) as fleet:
        assert fleet.server.settle(30)
        # Who has copied is known from before, and is said once.
        assert len(said(fleet, f"map {map_id} is ")) == 1
        assert sound_links(fleet) == links
        assert [where[0] for where in whereabouts(fleet.where())] == places


def sound_links(fleet: Fleet) -> set[tuple[NodeId, NodeId]]:
    liars = {FIRST, LAST}
    return {link.pair for link in fleet.server.merged().links if liars.isdisjoint({link.a.map, link.b.map})}


def test_no_log_is_as_long_as_the_greatest_number(tmp_path, caplog):
    """It is not waited for; the log goes on."""
    with serving(tmp_path / "s0.sqlite") as fleet:
        fleet.acks_of(LAST.agent)
        fleet.bus.publish(KEYS.head(LAST), Head(7, MAX_NUMBER).encode())
        # A newer beacon takes the place of one at which the server has not looked yet.
        eventually(lambda: f"change {MAX_NUMBER} is announced" in caplog.text)
        words = f"map {LAST} is implausible: change {MAX_NUMBER} is announced"
        fleet.tell(LAST, messages(LAST, views(LAST, Pose2(), STEP)))
        assert fleet.server.settle(30)
        assert said(fleet, words), [event.words for event in fleet.server.history()]
    # Only the beacon has said it: the log on the disk shows nothing.
    with serving(tmp_path / "s0.sqlite") as fleet:
        assert fleet.server.settle(30)
        assert fleet.server.merged().implausible.keys() == {LAST}
        assert len(said(fleet, words)) == 1


@pytest.mark.parametrize("clock", ["", "utc"])
def test_a_map_with_a_clock_that_runs_backwards_is_joined_and_moves_no_other(clock: str):
    """Its times contradict each other; its views are true, and those of an honest robot move the others."""
    alone, beside = sound_merger(), sound_merger()
    steps = [a.inverse() @ b @ Pose2(0.01, -0.01, 0.005) for a, b in pairwise(TOUR)]
    nodes = take_map(WORLD, LAST, TOUR, np.random.default_rng(8))[0]
    log = driven(LAST, nodes, steps)
    take_in(beside, LAST, backwards(log, clock) if clock else log)
    before, after = alone.merged(), beside.merged()
    first, second = before.maps
    assert after.joined(first, LAST) and after.joined(first, second)
    assert (LAST in after.implausible) is bool(clock)
    moved = most_moved(before, after)
    assert moved < 1e-6 if clock else moved > 1e-3


@pytest.mark.parametrize("lies", [False, True], ids=["honest", "its clock runs backwards"])
def test_an_implausible_map_does_not_join_what_nothing_else_joins(lies: bool):
    """Two robots in two rooms have no node in common, and a third one has been in both."""
    other = Pose2(20.0, 0.0, 0.0)
    world = WORLD + room(20, 0, 5, 4, 600, np.random.default_rng(2))
    tours = {MapId("b", 1): TOUR, MapId("r", 1): [other @ pose for pose in TOUR[:3]]}
    alone, beside = Merger(), Merger()
    for number, (map_id, tour) in enumerate(tours.items()):
        contents = changes_of(*take_map(world, map_id, tour, np.random.default_rng(number)))
        for merger in (alone, beside):
            take_in(merger, map_id, contents)
    before = alone.merged()
    assert len(before.components) == 2
    way = [*tours[MapId("b", 1)], *tours[MapId("r", 1)]]
    nodes = take_map(world, LAST, way, np.random.default_rng(8))[0]
    log = driven(LAST, nodes, [a.inverse() @ b for a, b in pairwise(way)])
    end = next(iter(before.components[0]))
    last = NodeId(*LAST, 2 * len(nodes) - 1)
    drive = Edge(NodeId(*LAST, 900), last, end, PoseGaussian(Pose2(), STEP), EdgeKind.DRIVEN)
    log.append(EdgePut(drive))
    take_in(beside, LAST, backwards(log) if lies else log)
    after = beside.merged()
    first, second = tours
    assert after.joined(first, second) is not lies
    if not lies:
        return
    # It stays where most links tie it, and the page says why the others do not hold.
    assert after.implausible.keys() == {LAST}
    assert after.joined(first, LAST) and not after.joined(second, LAST)
    refused = [one for one in after.refused if one.reason == f"map {LAST} {ALONE}"]
    assert refused and all({end.map for end in one.pair} == {second, LAST} for one in refused)
    assert drive.id in {one.edge for one in after.refused}
    for component in before.components:
        for node in component:
            assert before.pose(node).distance(after.pose(node)) < 1e-6
    assert after.components == tuple(frozenset(graph.nodes) for graph in after.graphs)
    assert {node for graph in after.graphs for node in graph.nodes} == set(after.poses)
    assert beside.merged() is after
    # A person who links the two by hand vouches for it.
    link = refused[0].link
    assert link is not None
    spread = link.a_from_b.covariance[np.triu_indices(3)]
    by_hand = Linked(*link.pair, link.a_from_b.mean, tuple(spread.tolist()))
    beside.constrain(ManualConstraints([ManualConstraint(by_hand, True, "bob", 0)]))
    assert beside.merged().joined(first, second)


@pytest.mark.parametrize("lies", [False, True], ids=["honest", "its clock runs backwards"])
def test_an_implausible_map_bears_out_no_links_of_others(lies: bool):
    """Two robots have one weak link, which is too little, until a third one has been where both were."""
    other = Pose2(20.0, 0.0, 0.0)
    world = WORLD + room(20, 0, 5, 4, 600, np.random.default_rng(2))
    there = [other @ pose for pose in TOUR[:3]]
    tours = {MapId("b", 1): TOUR, MapId("r", 1): [*there, TOUR[1] @ Pose2(0.05, 0.02, 0.03)]}
    merger = Merger()
    for number, (map_id, tour) in enumerate(tours.items()):
        nodes, edges = take_map(world, map_id, tour, np.random.default_rng(number))
        if map_id.agent == "r":
            nodes[-1] = replace(nodes[-1], landmarks=nodes[-1].landmarks.take(np.arange(40)))
            edges[-1] = replace(edges[-1], shared=edges[-1].shared[:0])
        take_in(merger, map_id, changes_of(nodes, edges))
    before, (first, second) = merger.merged(), tours
    assert not before.joined(first, second)
    few = {one.pair for one in before.refused if one.reason.startswith("no 2 links that share no node agree")}
    assert few and all({end.map for end in pair} == {first, second} for pair in few)
    way = [*TOUR, *there]
    nodes = take_map(world, LAST, way, np.random.default_rng(8))[0]
    log = driven(LAST, nodes, [a.inverse() @ b for a, b in pairwise(way)])
    take_in(merger, LAST, backwards(log) if lies else log)
    after = merger.merged()
    assert after.joined(first, second) is not lies
    if not lies:
        return
    assert after.implausible.keys() == {LAST}
    assert few <= {one.pair for one in after.refused}
    assert {one.pair for one in after.refused if one.reason == BORNE_OUT} <= few
    assert [link.pair for link in after.links if LAST not in link.maps] == [
        link.pair for link in before.links
    ]
    assert after.components == tuple(frozenset(graph.nodes) for graph in after.graphs)
    for node, pose in before.poses.items():
        assert after.pose(node).distance(pose.merged_from_robot.mean) < 1e-6
    # What it was before comes back with the implausible map gone, and stays while others go on.
    merger.constrain(ManualConstraints([ManualConstraint(RetiredMap(LAST), True, "bob", 0)]))
    assert [link.pair for link in merger.merged().links] == [link.pair for link in before.links]


def test_a_map_of_which_a_change_was_refused_moves_no_other():
    """No robot sends such a change. What else it sends may be true: it is placed behind others."""
    merger = sound_merger()
    first, second = merger.maps
    assert merger.merged().joined(first, second)
    alone = Merger()
    for message in sound_logs()[first]:
        alone.on_change(decode_change(message))
    for note, words in (
        (merger.note_disbelief, "change 9 is announced, where 3 have come"),
        (merger.note_refusal, "change 3 is refused (edge r1.1.2 is 99000 m long)"),
    ):
        note(second, words)
        merged = merger.merged()
        assert merged.implausible == {second: words} and merged.joined(first, second)
        for node, pose in alone.merged().poses.items():
            assert merged.pose(node).distance(pose.merged_from_robot.mean) < 1e-6


def test_edges_that_no_robot_measures():
    own, other = NodeId(*LAST, 1), NodeId(*FIRST, 3)
    for end, kind, x, variance, words in (
        (NodeId(*LAST, 3), EdgeKind.LOOP, 3.0, 0.1, ""),
        (other, EdgeKind.DRIVEN, 999.0, 99.0, ""),
        (other, EdgeKind.DRIVEN, 1001.0, 0.1, "is 1001 m long"),
        (other, EdgeKind.DRIVEN, 3.0, 144.0, "deviation of 12 m"),
        (NodeId(*LAST, 3), EdgeKind.MAPPED, 3.0, 0.0, "edge z.1.2 has no uncertainty"),
        (NodeId(*LAST, 3), EdgeKind.MAPPED, 3.0, 1e-8, ""),
        (other, EdgeKind.LOOP, 3.0, 0.1, "is loop and joins nodes of others"),
    ):
        pose = PoseGaussian(Pose2(x), variance * np.eye(3))
        edge = Edge(NodeId(*LAST, 2), own, end, pose, kind)
        assert words in unmeasurable(edge) and bool(words) == bool(unmeasurable(edge))


@pytest.mark.slow
def test_fragments_make_no_answer_ambiguous():
    """A robot begins map after map, each with two views of the room and a wrong way between them."""
    merger = sound_merger()
    assert certainties(merger, merger.merged()) == [Certainty.FOUND] * 2
    for epoch in range(1, MOST_FRAGMENTS + 2):
        map_id = MapId(LAST.agent, epoch)
        take_in(merger, map_id, views(map_id, Pose2(1.0, 2.0, 0.5), STEP)[:3])
    merged = merger.merged()
    assert list(merged.implausible) == [MapId(LAST.agent, epoch) for epoch in range(1, MOST_FRAGMENTS + 2)]
    assert certainties(merger, merged) == [Certainty.FOUND] * 2


def test_many_bad_maps_speak_against_a_robot_unless_most_of_its_nodes_are_sound():
    nodes = take_map(WORLD, LAST, [*TOUR] * 7, np.random.default_rng(8))[0]

    def held(size: int) -> HybridMap:
        out = HybridMap()
        for node in nodes[:size]:
            out.apply(NodePut(node))
        return out

    small = {MapId("z", epoch): held(3) for epoch in range(1, MOST_FRAGMENTS + 2)}
    assert unreliable_robots(small, ()) == {"z": {*small}}
    assert not unreliable_robots(dict(list(small.items())[:-1]), ())
    large = {MapId("z", 50): held(3 * len(small))}
    assert not unreliable_robots(small | large, ())
    assert unreliable_robots(small | large, [*large]) == {"z": {*small, *large}}


@pytest.mark.parametrize("wrong", [0, 3, 4])
def test_a_map_that_contradicts_itself_is_named(wrong: int):
    """Its own loops do; what a server recognises may be a place that looks the same."""
    tour = [*TOUR, *TOUR]
    steps = [a.inverse() @ b for a, b in pairwise(tour)]
    nodes = take_map(WORLD, LAST, tour, np.random.default_rng(8))[0]
    merger = Merger()
    log = driven(LAST, nodes, steps)
    ends = [(i, j) for i in range(len(tour)) for j in range(i + 2, len(tour))][:6]
    for k, (i, j) in enumerate(ends):
        off = Pose2(1.0) if k < wrong else Pose2()
        pose = PoseGaussian(tour[i].inverse() @ tour[j] @ off, STEP)
        edge = Edge(
            NodeId(*LAST, 100 + k), NodeId(*LAST, 2 * i + 1), NodeId(*LAST, 2 * j + 1), pose, EdgeKind.LOOP
        )
        log.append(EdgePut(edge))
    take_in(merger, LAST, log)
    found = merger.merged().implausible
    assert list(found) == ([LAST] if wrong > 3 else [])
    assert not found or found[LAST].startswith("it contradicts itself: 4 of its 6 loops")


@pytest.mark.parametrize("count", first_quick([MOST_FRAGMENTS + 1, MOST_FRAGMENTS], 0))
def test_many_maps_of_one_robot_that_contradict_each_other_make_no_answer_ambiguous(count: int):
    """Each has true views in an order of its own, with wrong ways between them."""
    merger, rng = sound_merger(), np.random.default_rng(3)
    nodes = take_map(WORLD, LAST, TOUR, np.random.default_rng(8))[0]
    for epoch in range(1, count + 1):
        map_id = MapId(LAST.agent, epoch)
        steps = [Pose2.from_vector(rng.uniform(-3.0, 3.0, 3)) for _ in nodes[1:]]
        take_in(merger, map_id, driven(map_id, nodes, steps))
    merged = merger.merged()
    assert len(merged.implausible) == (count if count > MOST_FRAGMENTS else 0)
    if merged.implausible:
        assert certainties(merger, merged) == [Certainty.FOUND] * 2


def test_a_view_that_comes_again_in_many_fragments_moves_no_nodes_of_others():
    """It is true, and would count as often as it comes."""
    merger, rng = sound_merger(), np.random.default_rng(3)
    before = merger.merged()
    beside = Pose2(0.1, 0.1, 0.2)
    nodes = take_map(WORLD, LAST, [TOUR[3], TOUR[3] @ beside, TOUR[0]], np.random.default_rng(8))[0]
    # Of the third view less is seen: else nothing would be joined.
    nodes[2] = replace(nodes[2], landmarks=nodes[2].landmarks.take(np.arange(0, 90, 2)))
    for epoch in range(1, MOST_FRAGMENTS + 2):
        steps = [beside, Pose2.from_vector(rng.uniform(-3.0, 3.0, 3))]
        take_in(merger, MapId(LAST.agent, epoch), driven(MapId(LAST.agent, epoch), nodes, steps))
    after = merger.merged()
    maps = {MapId(LAST.agent, epoch) for epoch in range(1, MOST_FRAGMENTS + 2)}
    assert {end.map for link in after.links for end in link.pair} & maps, "some are joined"
    assert most_moved(before, after) < 1e-6
    assert after.implausible.keys() == maps


def test_places_of_an_implausible_map_answer_only_where_no_other_map_does():
    """Alone it may know a place; beside others it is no second place, linked with them or not."""
    merger = sound_merger()
    take_in(merger, LAST, views(LAST, Pose2(1.0, 2.0, 0.5), STEP))
    merged = merger.merged()
    # As if its nodes had been compared with no others: none is known to be misplaced.
    unlinked = replace(merged, refused=(), wrong={})
    assert {node.map for node in merged.components[-1]} == {LAST} and not merged.implausible
    assert certainties(merger, unlinked) == [Certainty.AMBIGUOUS] * 2
    odd = replace(unlinked, implausible={LAST: "it contradicts itself"})
    assert certainties(merger, odd) == [Certainty.FOUND] * 2
    every = replace(unlinked, implausible=dict.fromkeys(merged.maps, "it contradicts itself"))
    assert certainties(merger, every) == [Certainty.AMBIGUOUS] * 2


def test_a_joined_fragment_makes_no_answer_ambiguous_and_a_robot_alone_in_twin_rooms_does():
    """The fragment has two views where they are, and a third one elsewhere."""
    merger = sound_merger()
    beside = Pose2(0.1, 0.1, 0.2)
    tour = [TOUR[3], TOUR[3] @ beside, TOUR[0]]
    # The newest map of a robot is no fragment. Of the third view less is seen: else nothing would be joined.
    for epoch, count in ((1, 3), (2, 1)):
        map_id = MapId(LAST.agent, epoch)
        nodes = take_map(WORLD, map_id, tour[:count], np.random.default_rng(8))[0]
        nodes[2:] = [replace(one, landmarks=one.landmarks.take(np.arange(0, 90, 2))) for one in nodes[2:]]
        take_in(merger, map_id, driven(map_id, nodes, [beside, Pose2(1.0, 2.0, 0.5)]))
    assert {MapId(LAST.agent, 1)} <= {node.map for node in merger.merged().components[0]}
    assert certainties(merger, merger.merged()) == [Certainty.FOUND] * 2
    # Alone, and in one map: no other robot says that the second room is there.
    steps = [a.inverse() @ b for a, b in pairwise(TOUR)]
    nodes = take_map(WORLD, FIRST, [*TOUR, *TOUR], np.random.default_rng(5))[0]
    take_in(merger, FIRST, driven(FIRST, nodes, [*steps, Pose2(20.0), *steps]))
    assert not merger.merged().wrong
    assert certainties(merger, merger.merged()) == [Certainty.AMBIGUOUS] * 2


def test_nothing_is_concluded_from_a_clock_that_runs_backwards():
    nodes = [
        replace(node, stamp_ns=k * 10**10, clock="utc")
        for k, node in enumerate(take_map(WORLD, LAST, TOUR, np.random.default_rng(8))[0])
    ]
    assert len(trajectories_of(nodes)) == 1
    for back, known in ((0.9, True), (1.1, False)):
        late = replace(nodes[1], stamp_ns=nodes[0].stamp_ns - round(back * 1e9) + 10**10)
        ahead = replace(nodes[0], stamp_ns=10**10)
        assert len(trajectories_of([ahead, late])) == known


@pytest.mark.slow
def test_maps_that_may_not_be_right_supersede_no_nodes_of_others():
    """They would answer no more, and be deleted after two weeks."""
    true = [body.node for body in views(LAST, Pose2(), STEP) if isinstance(body, NodePut)]
    superseded: dict[str, dict[NodeId, NodeId]] = {}
    for lie in ("", "clock", "fragments", "silence"):
        merger = sound_merger()
        nodes = true * (MOST_FRAGMENTS if lie == "fragments" else lie != "silence")
        for k, node in enumerate(nodes, start=1):
            # Later than all others; the clock runs backwards, if there is one.
            stamp_ns = 10**15 - k * 10**9 if lie == "clock" else 10**15 + k * 10**9
            epoch = k if lie == "fragments" else LAST.epoch
            new = replace(node, id=NodeId(LAST.agent, epoch, node.id.number), stamp_ns=stamp_ns)
            new = replace(new, clock="utc" if lie == "clock" else "")
            merger.on_change(Change(new.id.map, k, stamp_ns, NodePut(new)))
        merged = merger.merged()
        assert (LAST in merged.implausible) is (lie in ("clock", "fragments"))
        others = {node: fate.by for node, fate in merged.superseded.items() if node.agent != LAST.agent}
        superseded[lie] = others
    assert any(by.map == LAST for by in superseded[""].values()), "an honest robot's newer nodes do"
    assert superseded["clock"] == superseded["fragments"] == superseded["silence"]
