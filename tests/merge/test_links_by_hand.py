"""Links by hand: taken where images and map agree, refused with the evidence where they do not, and kept."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.annotation import Annotation, Annotations, Floor, Place
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.change import Change, EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
    Subject,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.annotator import check_annotation
from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.constraint_checks import check_manual_constraint
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import MOST_SIGMA_XY
from mapweave.storage.map_file import pack_map_file, unpack_map_file
from synthetic.maps import changes_of, numbered
from synthetic.world import World, room, take_map

A, B = MapId("a", 1), MapId("b", 1)
EAST = Pose2(12.0, 0.0, 0.0)
"""Where the second of two rooms is that look alike."""


class Scene:
    """Robots in rooms, with the truth of every node."""

    def __init__(self, world: World, seed: int = 3) -> None:
        self.world, self.rng = world, np.random.default_rng(seed)
        self.merger = Merger()
        self.truth: dict[NodeId, Pose2] = {}
        self.constraints = ManualConstraints()

    def drive(self, map_id: MapId, stops: Sequence[Pose2], clock: str = "", sigma: float = 0.01) -> None:
        nodes, edges = take_map(self.world, map_id, list(stops), self.rng, None, sigma, sigma)
        self.truth |= dict(zip((node.id for node in nodes), stops, strict=True))
        for change in [*(NodePut(replace(n, clock=clock)) for n in nodes), *map(EdgePut, edges)]:
            self.merger.apply(map_id, change)

    def true(self, a: NodeId, b: NodeId) -> Pose2:
        return self.truth[a].inverse() @ self.truth[b]

    def ask(self, about: Linked | Apart | RetiredMap, holds: bool = True, because: str = "") -> str:
        """As a server does."""
        stamp = len(self.constraints.made) + 1
        asked = ManualConstraint(about, holds, "anna", stamp, because)
        checked = check_manual_constraint(self.merger.merged(), self.constraints, asked)
        self.constraints = ManualConstraints([*self.constraints.made, checked.constraint])
        self.merger.constrain(self.constraints)
        return checked.effects


def node(map_id: MapId, number: int) -> NodeId:
    return NodeId(map_id.agent, map_id.epoch, number)


@pytest.fixture
def seam() -> Scene:
    """Two robots turn on the spot in one hall; only a's last view and b's first show the same: too little."""
    scene = Scene(room(0, 0, 6, 5, 300, np.random.default_rng(1)))
    scene.drive(A, [Pose2(2.5, 2.5, 1.0 * k) for k in range(3)])
    scene.drive(B, [Pose2(2.7, 2.4, 2.05 + 1.0 * k) for k in range(3)])
    return scene


LAST, FIRST = node(A, 5), node(B, 1)


def same(one: MergedMap, other: MergedMap) -> bool:
    return pack_map_file(map_file_of(replace(one, constraints=ManualConstraints()))) == pack_map_file(
        map_file_of(replace(other, constraints=ManualConstraints()))
    )


def test_a_link_that_the_merge_lacks_joins_two_maps_at_the_right_pose(seam: Scene):
    before = seam.merger.merged()
    assert len(before.components) == 2 and not before.links
    effects = seam.ask(Linked(FIRST, LAST))
    assert "landmarks of the images agree on one pose" in effects
    merged = seam.merger.merged()
    assert len(merged.components) == 1 and [link.pair for link in merged.links] == [(LAST, FIRST)]
    relative = merged.relative(LAST, FIRST)
    assert relative is not None and relative.mean.distance(seam.true(LAST, FIRST)) < 0.05
    explanation = explain_nodes(merged, LAST, FIRST)
    assert "linked by hand by anna" in explanation.reason and len(explanation.shared) > 10
    again = merged_of(unpack_map_file(pack_map_file(map_file_of(merged))))
    assert [link.pair for link in again.links] == [(LAST, FIRST)] and again.components == merged.components
    assert again.constraints.links.keys() == {(LAST, FIRST)}
    with pytest.raises(InvalidValue, match=r"linked by hand by anna on .* already"):
        seam.ask(Linked(FIRST, LAST))
    seam.ask(Linked(FIRST, LAST), holds=False)
    assert same(seam.merger.merged(), before), "to the bit"


def test_a_link_stays_when_the_robot_maps_on_and_an_undone_one_waits(seam: Scene):
    seam.ask(Linked(LAST, FIRST))
    nodes, edges = take_map(seam.world, B, [Pose2(2.7, 2.4, 2.05 + 1.0 * k) for k in range(5)], seam.rng)
    for change in numbered(B, changes_of(nodes[3:], edges[2:]), 90):
        seam.merger.on_change(change)
    joined = seam.merger.merged()
    assert len(joined.components) == 1 and len(joined.poses) == 8
    seam.ask(Apart((LAST, FIRST)))
    assert len(seam.merger.merged().components) == 2
    with pytest.raises(InvalidValue, match=r"cannot be linked: undone by anna .* take that back first"):
        seam.ask(Linked(LAST, FIRST, Pose2()))
    seam.ask(Apart((LAST, FIRST)), holds=False)
    assert same(seam.merger.merged(), joined)


@pytest.mark.parametrize(
    ("about", "words"),
    [
        (RetiredNodes((LAST,)), f"node {LAST}"),
        (RetiredWindow(A, 0, 10**18), f"map {A} until"),
        (RetiredArea(Area(node(A, 1), ((-5, -5), (5, -5), (5, 5), (-5, 5)))), "the area of 4 corners"),
    ],
)
def test_a_link_at_a_node_that_is_retired_a_moment_before_is_refused(seam: Scene, about: Subject, words: str):
    """Before the merge with the retirement it was taken, and had no effect."""
    before = seam.merger.merged()
    retired = ManualConstraint(about, True, "anna", 1, "a mirror")
    linked = ManualConstraint(Linked(LAST, FIRST), True, "bob", 2)
    with pytest.raises(InvalidValue, match=rf'cannot be linked: {words}.* retired by anna .*: "a mirror"; '):
        check_manual_constraint(before, ManualConstraints([retired]), linked)
    # Taken back, and merged neither.
    seam.merger.constrain(ManualConstraints([retired]))
    taken_back = ManualConstraints([retired, replace(retired, holds=False)])
    with pytest.raises(InvalidValue, match=f"{LAST} is in use again with the next merge: say it again then"):
        check_manual_constraint(seam.merger.merged(), taken_back, linked)
    seam.merger.constrain(taken_back)
    assert check_manual_constraint(seam.merger.merged(), taken_back, linked).constraint.holds


def test_images_that_do_not_agree_are_refused_unless_a_person_knows_better(seam: Scene):
    pair = node(A, 1), node(B, 5)
    with pytest.raises(InvalidValue, match=r"do not show one place: \d+ features? match"):
        seam.ask(Linked(*pair))
    # Where they agree, they know better than a person.
    with pytest.raises(InvalidValue, match=r"agree on another pose, .* from yours; leave your pose out"):
        seam.ask(Linked(LAST, FIRST, seam.true(LAST, FIRST) @ Pose2(1.0, 0.0, 0.0)), because="sure")
    true = seam.true(*pair)
    with pytest.raises(InvalidValue, match="needs a reason"):
        seam.ask(Linked(*pair, true))
    assert "by hand alone" in seam.ask(Linked(*pair, true), because="measured with a tape")
    merged = seam.merger.merged()
    assert len(merged.components) == 1
    explanation = explain_nodes(merged, *pair)
    assert "the pose is a person's" in explanation.reason and '"measured with a tape"' in explanation.reason
    other = node(A, 3), node(B, 5)
    with pytest.raises(
        InvalidValue, match=r"standard deviations, at most 4.0 pass. The link by hand of a.1.1"
    ):
        seam.ask(Linked(*other, seam.true(*other) @ Pose2(2.0, 0.0, 0.0)), because="sure")


def test_a_loop_by_hand_must_fit_the_robots_own_way():
    """Two rooms that look the same, in one drive: images cannot tell them apart, the drive can."""
    one = room(0, 0, 5, 4, 500, np.random.default_rng(1))
    scene = Scene(one + one.moved(EAST))
    inside = [Pose2(2.0, 2.0, 0.9 * k) for k in range(3)]
    between = [Pose2(2.0 + 2.0 * k, -1.0, 0.0) for k in range(7)]
    back = [Pose2(14.0 - 2.0 * k, -1.5, 3.1) for k in range(7)]
    tour = [
        *inside,
        *between,
        *(EAST @ stop for stop in inside),
        *back,
        *(s @ Pose2(0.1, 0, 0.05) for s in inside),
    ]
    scene.drive(A, tour, sigma=0.03)
    ids = [node(A, 2 * k + 1) for k in range(len(tour))]
    with pytest.raises(InvalidValue, match=r"Map a\.1 says so by its robot's own way") as refused:
        scene.ask(Linked(ids[0], ids[10]))
    assert "12.0" in str(refused.value) or "11.9" in str(refused.value), "by how much it is off"
    # As if the merge had found no loop itself; the last view shows other things than the first.
    found = [link.pair for link in scene.merger.merged().links]
    scene.constraints = ManualConstraints(ManualConstraint(Apart(p), True, "bob", 0) for p in found)
    scene.merger.constrain(scene.constraints)
    closed, errors = (ids[0], ids[22]), []
    for because in ("the same doormat", ""):
        now = scene.merger.merged().relative(*closed)
        assert now is not None
        errors.append(now.mean.distance(scene.true(*closed)))
        if because:
            scene.ask(Linked(*closed, scene.true(*closed)), because=because)
    assert [link.pair for link in scene.merger.merged().links] == [closed]
    assert errors[1] < MOST_SIGMA_XY and errors[1] < errors[0] / 2


def test_robots_that_would_have_been_in_one_place_at_one_time_are_not_linked():
    one = room(0, 0, 5, 4, 600, np.random.default_rng(1))
    scene = Scene(one + one.moved(EAST))
    walk = [Pose2(1.0 + 0.3 * k, 2.0, 0.1 * k) for k in range(8)]
    scene.drive(A, walk, clock="net")
    scene.drive(B, [EAST @ stop @ Pose2(0.05, 0.02, 0.0) for stop in walk], clock="net")
    merged = scene.merger.merged()
    assert len(merged.components) == 2
    with pytest.raises(InvalidValue, match="cannot be linked: a and b would have been at the same place"):
        scene.ask(Linked(node(A, 5), node(B, 5)))
    assert not scene.constraints.made


def test_what_contradicts_a_link_later_is_reported_and_the_link_stays(seam: Scene):
    """A person is wrong by a metre, and then the robots see what is so."""
    wrong = seam.true(LAST, node(B, 5)) @ Pose2(1.0, 0.5, 0.0)
    seam.ask(Linked(LAST, node(B, 5), wrong), because="a guess")
    history = MapHistory(clock=lambda: 7)
    history.follow(seam.merger.merged())
    assert not seam.merger.merged().contradicted
    third = MapId("c", 1)
    seam.drive(third, [Pose2(2.6, 2.5, 0.5 * k) for k in range(10)])
    merged = seam.merger.merged()
    assert (LAST, node(B, 5)) in {link.pair for link in merged.links}
    history.follow(merged)
    history.follow(merged)
    said = [event.words for event in history.events if event.kind == "contradicted"]
    assert (
        len(said) == 1 and "the link by hand of a.1.5 and b.1.5: without it robots' measurements" in said[0]
    )
    assert "1.1" in said[0], "m: the length of (1, 0.5)"
    assert "without it robots' measurements" in explain_nodes(merged, LAST, node(B, 5)).reason
    seam.ask(Linked(LAST, node(B, 5)), holds=False)
    assert not seam.merger.merged().contradicted


def test_links_by_hand_and_labels_of_floors_know_of_each_other(seam: Scene):
    seam.constraints = ManualConstraints(floors={A: "1", B: "2"})
    with pytest.raises(InvalidValue, match=rf"cannot be linked: {LAST} is on floor 1, {FIRST} on floor 2"):
        seam.ask(Linked(LAST, FIRST))
    seam.constraints = ManualConstraints()
    seam.ask(Linked(LAST, FIRST))
    merged = seam.merger.merged()
    first = Annotation(str(A), Floor(LAST, "1"), False, "anna", 1)
    second = Annotation(str(B), Floor(FIRST, "2"), False, "anna", 2)
    with pytest.raises(
        InvalidValue, match=rf"map {A} is on floor 1, and {LAST} and {FIRST} are linked by hand"
    ):
        check_annotation(merged, Annotations((first,)), second, seam.constraints)
    same_floor = replace(second, body=Floor(FIRST, "1"))
    check_annotation(merged, Annotations((first,)), same_floor, seam.constraints)
    undone = ManualConstraints([*seam.constraints.made, replace(seam.constraints.made[0], holds=False)])
    check_annotation(merged, Annotations((first,)), second, undone)


def test_a_place_at_a_retired_node_is_refused_with_what_retired_it(seam: Scene):
    retired = ManualConstraint(RetiredNodes((LAST,)), True, "anna", 10**18, "a mirror")
    seam.merger.constrain(ManualConstraints([retired]))
    merged, kitchen = seam.merger.merged(), Annotation("kitchen", Place(LAST), False, "anna", 1)
    with pytest.raises(
        InvalidValue, match=rf'{LAST} is not in the merged map \(.*retired by anna .*: "a mirror"'
    ):
        check_annotation(merged, Annotations(()), kitchen, ManualConstraints([retired]))
    # Taken back, and not merged yet.
    taken_back = ManualConstraints([retired, replace(retired, holds=False)])
    with pytest.raises(InvalidValue, match=f"{LAST} is in use again with the next merge: say it again then"):
        check_annotation(merged, Annotations(()), kitchen, taken_back)
    seam.merger.constrain(taken_back)
    check_annotation(seam.merger.merged(), Annotations(()), kitchen, taken_back)


def test_a_drive_from_map_to_map_is_evidence_against_labels_and_likeness_is_not():
    scene = Scene(room(0, 0, 6, 5, 700, np.random.default_rng(1)))
    for which in (A, B):
        scene.drive(which, [Pose2(2.5, 2.5, 1.0 * k) for k in range(3)])
    first = Annotation(str(A), Floor(node(A, 1), "1"), False, "anna", 1)
    second = Annotation(str(B), Floor(node(B, 1), "2"), False, "anna", 2)
    merged = scene.merger.merged()
    assert len(merged.components) == 1, "they look the same"
    with pytest.raises(InvalidValue, match=rf"on floor 1 .* fall and {B} parts from {A}\. .* needs a reason"):
        check_annotation(merged, Annotations((first,)), second, ManualConstraints())
    because = replace(second, because="twin rooms")
    check_annotation(merged, Annotations((first,)), because, ManualConstraints())
    between = merged.relative(node(A, 1), node(B, 1))
    assert between is not None
    drive = Edge(EdgeId(*A, 99), node(A, 1), node(B, 1), between, EdgeKind.DRIVEN)
    scene.merger.on_change(Change(A, 99, 0, EdgePut(drive)))
    with pytest.raises(InvalidValue, match=r"a robot has driven between a\.1\.1 and b\.1\.1"):
        check_annotation(scene.merger.merged(), Annotations((first,)), because, ManualConstraints())
