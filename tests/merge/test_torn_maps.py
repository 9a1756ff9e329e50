"""A map with two robots' places in another arrangement is wrong; a place that looks the same is not."""

from collections.abc import Iterator

import numpy as np
import pytest

from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.merging import copies as copied_nodes
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.wrong_geometry import MOST_LINKS, is_torn
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import thinned
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ConsistencySettings
from mapweave.scenarios.liar.lies import LieInputs, altered, altered_places, bodies, chain
from mapweave.wire.codec import decode_change
from synthetic.wrong_geometry import ODD, SCENES, FaultyFleet, OdometryFault, draw_fleet
from tests.examined import examined_once
from tests.quick import first_quick

SEED = 5
AWAY, TORN, NOT_OFF = Pose2(40.0, -10.0, 2.0), Pose2(2.0, -2.0, 1.0), Pose2()


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


@pytest.mark.parametrize(
    ("seed", "shift", "torn"),
    first_quick([(SEED, TORN, True), (SEED, Pose2(), False), (301, TORN, True), (302, TORN, True)], 1),
)
def test_two_robots_that_agree_contradict_a_torn_map(seed: int, shift: Pose2, torn: bool):
    """It has their places in another arrangement; in theirs it is one map with them."""
    merged = joined_with_copies(draw_fleet(seed, SCENES["house"], OdometryFault.NONE, stops=2), shift)
    assert merged.wrong.keys() == ({ODD} if torn else set())
    apart = [{"r0", "r1", "r2"}, {"r3"}] if torn else [{"r0", "r1", "r2", "r3"}]
    assert [{node.agent for node in part} for part in merged.components] == apart


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "torn"), [(TORN, True), (Pose2(), False)])
def test_nodes_that_are_a_little_off_are_of_no_other_place(fleet: FaultyFleet, shift: Pose2, torn: bool):
    """They counted as of another one: a map with everything nearly where it is seemed torn."""
    merged = joined_with_copies(fleet, shift, in_turns=True, off=Pose2(0.5, 0.4, 0.0))
    found = [*merged.links, *(r.link for r in merged.refused if r.link is not None)]
    links = [link if link.a.map == ODD else link.turned() for link in found if ODD in link.maps]
    others = [link for link in found if ODD not in link.maps]
    placed, fixed = (
        merge_maps({k: v for k, v in merged.maps.items() if (k == ODD) is odd}, [] if odd else others)
        for odd in (True, False)
    )
    (own,), (theirs,) = placed.graphs, fixed.graphs
    pieces = Fragment(own.anchor, own, ()), Fragment(theirs.anchor, theirs, ())
    across = thinned([link for link in links if not link.within], MOST_LINKS)
    nodes = [merged.maps[ODD].nodes[node] for node in own.nodes]
    assert is_torn(across, *pieces, nodes, ConsistencySettings()) is torn


@pytest.mark.slow
def test_altered_copies_behind_a_true_drive_are_found_out_by_their_arrangement(fleet: FaultyFleet):
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
