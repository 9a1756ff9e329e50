"""A map with two robots' places in another arrangement is torn; a place that looks the same is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging import copies as copied_nodes
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge import torn_maps
from mapweave.merge.merging import merge_maps
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.links import RefusedLink, refuse
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.settings import ConsistencySettings
from mapweave.merge.torn_maps import TornMapSearch
from mapweave.scenarios.liar.lies import LieInputs, altered, altered_places, bodies, chain
from mapweave.wire.codec import decode_change
from synthetic.wrong_geometry import ODD, SCENES, FaultyFleet, OdometryFault, draw_fleet
from tests.examined import examined_once
from tests.quick import first_quick

SEED = 5
AWAY, TORN, NOT_OFF = Pose2(40.0, -10.0, 2.0), Pose2(2.0, -2.0, 1.0), Pose2()
EXCLUDED = "{} and r3 would have been at the same place at the same time: 0.01 m apart"


@pytest.fixture(scope="module", autouse=True)
def examined() -> Iterator[None]:
    """The nodes of every fleet here see the same; what differs is where its map has them."""
    with examined_once():
        yield


@pytest.fixture(scope="module", autouse=True)
def other_views() -> Iterator[None]:
    """The nodes here are views of places that look alike: the merge does not know them as copies."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(copied_nodes, "one_for_one", lambda *_: False)
        yield


@pytest.fixture(scope="module")
def fleet() -> FaultyFleet:
    return draw_fleet(SEED, SCENES["house"], OdometryFault.NONE, stops=2)


def joined_with_copies(
    fleet: FaultyFleet, shift: Pose2, *, in_turns: bool = False, off: Pose2 = NOT_OFF
) -> MergedMap:
    """Copies of r0's nodes, and of r1's shifted against where they are, merged with the true maps.

    The second robot's come after the first one's, or the two robots' in turns. Every fifth of the first one's
    is off.
    """
    rng = np.random.default_rng(SEED)
    sound = {map_id: content for map_id, content in fleet.maps.items() if map_id != ODD}
    both = [sound[MapId(k, 1)][0] for k in ("r0", "r1")]
    theirs = [node for some in (zip(*both, strict=True) if in_turns else both) for node in some]
    wrong = {node.id: off for node in both[0][::5]} | {node.id: shift for node in both[1]}
    poses = [AWAY @ wrong.get(node.id, NOT_OFF) @ fleet.truth[node.id] for node in theirs]
    copied = chain(
        LieInputs(ODD, fleet.maps[ODD], sound, rng), [altered(node, rng) for node in theirs], poses
    )
    merger = Merger()
    for map_id, content in {**sound, ODD: copied}.items():
        for body in bodies(content):
            merger.apply(map_id, body)
    return merger.merged()


@pytest.fixture(scope="module")
def copies(fleet: FaultyFleet) -> Callable[[Pose2], MergedMap]:
    """`joined_with_copies` by the shift, of which most tests have the same."""
    return cache(partial(joined_with_copies, fleet))


def beside(merged: MergedMap, excluding: tuple[str, ...]) -> MergedMap:
    """The copies beside the true maps: links with some robots are refused by mutual exclusion, others for
    want of support.
    """
    found = [*merged.links, *(r.link for r in merged.refused if r.link is not None)]
    mine = [link for link in found if (link.a.map == ODD) != (link.b.map == ODD)]

    def against(robot: str) -> str:
        return EXCLUDED.format(robot) if robot in excluding else "no 2 links agree"

    refused: list[RefusedLink] = [refuse(link, against(min(link.a.agent, link.b.agent))) for link in mine]
    others = [link for link in found if ODD not in {link.a.map, link.b.map}]
    return merge_maps(dict(merged.maps), others, refused)


@pytest.mark.parametrize(
    ("shift", "excluding", "torn"),
    first_quick(
        [
            (TORN, ("r0", "r1"), True),
            (Pose2(), ("r0", "r1"), False),
            (TORN, ("r0",), False),
            (TORN, (), False),
        ],
        1,
    ),
)
def test_two_robots_that_agree_exclude_a_torn_map(
    copies: Callable[[Pose2], MergedMap], shift: Pose2, excluding: tuple[str, ...], torn: bool
) -> None:
    merged = beside(copies(shift), excluding)
    assert [{node.agent for node in part} for part in merged.components] == [{"r0", "r1", "r2"}, {"r3"}]
    found = TornMapSearch(ConsistencySettings()).torn(merged)
    assert found.keys() == ({ODD} if torn else set())
    assert not torn or found[ODD].startswith(
        "it shows places of r0 and r1 in another arrangement than theirs"
    )


@pytest.mark.parametrize(("shift", "torn"), [(TORN, True), (Pose2(), False)])
def test_nodes_of_two_robots_in_turns_are_tested_beside_each_other(
    fleet: FaultyFleet, shift: Pose2, torn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of more nodes than are tested, those of one robot alone were tested: every second one."""
    merged = beside(joined_with_copies(fleet, shift, in_turns=True), ("r0", "r1"))
    # As in a large map: three in four nodes fit, so that every second one was tested.
    monkeypatch.setattr(torn_maps, "MOST_NODES", len(merged.maps[ODD].nodes) * 3 // 4)
    assert TornMapSearch(ConsistencySettings()).torn(merged).keys() == ({ODD} if torn else set())


@pytest.mark.parametrize(("shift", "torn"), [(TORN, True), (Pose2(), False)])
def test_nodes_that_are_a_little_off_are_of_no_other_place(
    fleet: FaultyFleet, shift: Pose2, torn: bool
) -> None:
    """They counted as of another one: a map with everything nearly where it is seemed torn."""
    off = Pose2(0.5, 0.4, 0.0)
    merged = beside(joined_with_copies(fleet, shift, in_turns=True, off=off), ("r0", "r1"))
    assert TornMapSearch(ConsistencySettings()).torn(merged).keys() == ({ODD} if torn else set())


@pytest.mark.slow
def test_what_did_not_change_is_not_tested_again(
    copies: Callable[[Pose2], MergedMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    merged, search = beside(copies(TORN), ("r0", "r1")), TornMapSearch(ConsistencySettings())
    assert search.torn(merged)
    tested = []
    monkeypatch.setattr("mapweave.merge.torn_maps.is_torn", lambda *_: tested.append(1))
    assert search.torn(merged) and not tested
    # Its robot has put a node again.
    maps = {**merged.maps, ODD: HybridMap(merged.maps[ODD].contents())}
    assert not search.torn(replace(merged, maps=maps)) and tested
    # The others have moved.
    assert search.torn(merged) == {} and len(tested) == 2
    graphs = tuple(copy(graph) if len(graph.maps) > 1 else graph for graph in merged.graphs)
    assert not search.torn(replace(merged, graphs=graphs, poses=NodePoses(graphs))) and len(tested) == 3


@pytest.mark.slow
def test_a_second_map_of_its_robot_that_joins_it_is_no_defect(copies: Callable[[Pose2], MergedMap]) -> None:
    """The same links are refused, of two maps instead of one. Before, the whole merge failed."""
    merged, search = beside(copies(TORN), ("r0", "r1")), TornMapSearch(ConsistencySettings())
    alone = next(graph for graph in merged.graphs if graph.maps == {ODD})
    assert search.torn(merged)
    more = MapId(ODD.agent, ODD.epoch + 1)
    node = replace(merged.maps[ODD].nodes[alone.nodes[0]], id=NodeId(*more, 1))
    both = solve_graph(alone.nodes[0], alone.pose(alone.nodes[0]), [
        *(RelativePose(edge.a, edge.b, edge.a_from_b) for edge in merged.maps[ODD].edges.values()),
        RelativePose(alone.nodes[0], node.id, PoseGaussian(Pose2(0.1, 0.0, 0.0), 1e-4 * np.eye(3))),
    ])  # fmt: skip
    graphs = tuple(both if graph is alone else graph for graph in merged.graphs)
    maps = {**merged.maps, more: HybridMap([NodePut(node)])}
    assert search.torn(replace(merged, maps=maps, graphs=graphs, poses=NodePoses(graphs))).keys() == {
        ODD,
        more,
    }


@pytest.mark.slow
def test_altered_copies_behind_a_true_drive_are_found_out_by_their_arrangement(fleet: FaultyFleet) -> None:
    """Copies of two robots' places, each robot's in its own frame: their map contradicts those that agree."""
    sound = {map_id: content for map_id, content in fleet.maps.items() if map_id != ODD}
    lie = altered_places(LieInputs(ODD, fleet.maps[ODD], sound, np.random.default_rng(SEED)))
    merger = Merger()
    for map_id, content in sound.items():
        for body in bodies(content):
            merger.apply(map_id, body)
    before = merger.merged()
    for message in lie.logs[ODD]:
        merger.apply(ODD, decode_change(message).body)
    merged = merger.merged()
    assert merged.wrong.keys() == {ODD}
    assert {link.key for link in merged.links if ODD not in link.maps} == {link.key for link in before.links}
