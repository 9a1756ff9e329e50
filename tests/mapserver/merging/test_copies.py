"""Who has copied landmarks of another robot, and who has not."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.merging.copies import LEAST_SAME, Copies, copied_landmarks, one_for_one
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.constraint_checks import check_manual_constraint
from mapweave.merge.settings import ConsistencySettings
from mapweave.merge.unmerged_links import with_unmerged_links
from mapweave.scenarios.liar.lies import altered
from mapweave.wire.codec import decode_change
from synthetic.world import take_map
from tests.mapserver.false_maps import FIRST, LAST, copies, driven
from tests.mapserver.test_set_apart import TOUR, WORLD, sound_logs


def test_who_shares_landmarks_with_most_has_copied_them_if_nothing_else_tells():
    """A server that has lost its disk may hear the one that lies first."""
    nodes = [body.node for body in copies(LAST) if isinstance(body, NodePut)]
    logs = [[decode_change(message).body for message in log] for log in sound_logs().values()]
    sound = [body.node for log in logs for body in log[:2] if isinstance(body, NodePut)]
    found = Copies()
    for one in (*nodes, *sound):
        found.came(one, None)
    for a, b in zip(nodes, sound, strict=True):
        found.compare(b, a)
    assert found.maps(frozenset()).keys() == {LAST}
    # Known from before: even if it is the other way round.
    assert found.maps(frozenset({sound[0].id.map})).keys() >= {sound[0].id.map}
    # Views of one room from about the same places share none.
    other = take_map(WORLD, LAST, TOUR, np.random.default_rng(9))[0]
    assert all(copied_landmarks(a, b) == 0 for a in other for b in sound)


def test_a_person_links_two_maps_of_one_recording():
    """They are copies of each other until then, and again when the link is taken back."""
    merger = Merger()
    log = [decode_change(message) for message in next(iter(sound_logs().values()))]
    again = [change.body.node for change in log if isinstance(change.body, NodePut)]
    steps = [a.inverse() @ b for a, b in pairwise(TOUR)]
    for change in log:
        merger.on_change(change)
    for number, body in enumerate(driven(LAST, again, steps), start=1):
        merger.on_change(Change(LAST, number, 0, body))
    merged = merger.merged()
    assert merged.set_apart.keys() == {LAST}
    asked = ManualConstraint(Linked(again[0].id, NodeId(*LAST, 1)), True, "anna", 1, "one recording")
    linked = check_manual_constraint(merged, ManualConstraints(), asked, merger.maps).constraint
    made = ManualConstraints([linked])
    # What is decided before the next merge must fit it already.
    unmerged = with_unmerged_links(merged, made, ConsistencySettings())
    last = max(merged.copies[LAST].nodes)
    wrong = Linked(again[0].id, last, Pose2(9.0, 9.0, 1.0))
    with pytest.raises(InvalidValue, match="cannot be linked so"):
        check_manual_constraint(unmerged, made, replace(asked, about=wrong), merger.maps)
    right = Linked(again[-1].id, last)
    assert check_manual_constraint(unmerged, made, replace(asked, about=right), merger.maps)
    merger.constrain(made)
    merged = merger.merged()
    assert not merged.set_apart and unmerged.poses.keys() == merged.poses.keys()
    assert max(unmerged.pose(node).distance(merged.pose(node)) for node in merged.poses) < 0.05
    assert with_unmerged_links(merged, made, ConsistencySettings()) is merged
    one, other = (merged.pose(node) for node in (again[0].id, NodeId(*LAST, 1)))
    assert merged.joined(again[0].id.map, LAST) and one.distance(other) < 0.05
    merger.constrain(ManualConstraints([linked, replace(linked, holds=False)]))
    assert merger.merged().set_apart.keys() == {LAST}
    # What is not believed is held against it also once it is linked, though the server starts again before.
    merger.note_disbelief(LAST, "change 9 is announced, where 3 have come")
    merged = merger.merged()
    assert merged.disbelieved.keys() == {LAST} and not merged.implausible


def test_a_robot_that_parks_where_another_one_has_mapped_has_copied_nothing():
    """Within a millimetre many descriptors are the same bit by bit; what it measured of them is not."""
    node = take_map(WORLD, FIRST, TOUR[:1], np.random.default_rng(4))[0][0]
    noise = np.random.default_rng(5)
    again = replace(
        node,
        id=NodeId(*LAST, 1),
        landmarks=replace(node.landmarks, depths=node.landmarks.depths * noise.uniform(0.97, 1.03)),
    )
    assert copied_landmarks(node, node) > 50
    found = Copies()
    found.compare(node, again)
    assert not found.maps(frozenset())


@pytest.mark.parametrize("many", [LEAST_SAME - 1, LEAST_SAME])
def test_nodes_with_the_landmarks_of_others_one_for_one_are_copies(many: int):
    """Noise of the pixels, the descriptors and the depths makes no other view: it has other landmarks."""
    true = take_map(WORLD, FIRST, TOUR, np.random.default_rng(4))[0][:many]
    assert len(true) == many
    rng = np.random.default_rng(5)
    found = Copies()
    for node in true:
        again = replace(altered(node, rng), id=NodeId(*LAST, node.id.number))
        assert copied_landmarks(node, again) == 0
        found.compare(node, again)
    copied = found.maps(frozenset())
    assert copied.keys() == ({LAST} if many == LEAST_SAME else set())
    assert not copied or copied[LAST].startswith(
        f"its node {LAST}.1 has the landmarks of {FIRST}.1 one for one"
    )
    assert not found.maps(frozenset(), [frozenset((FIRST, LAST))]), "a person has linked them"
    found.forget((true[0].id, NodeId(*LAST, true[0].id.number)))
    assert not found.maps(frozenset())


def test_views_from_the_very_same_places_are_no_copies():
    """As of robots that start at one mark, one after the other: each finds and keeps other features."""
    first, second = (
        take_map(WORLD, who, TOUR, np.random.default_rng(n))[0] for n, who in enumerate((FIRST, LAST))
    )
    assert len(first) >= LEAST_SAME
    found = Copies()
    for pair in zip(first, second, strict=True):
        assert not one_for_one(*pair)
        found.compare(*pair)
    assert not found.maps(frozenset())
