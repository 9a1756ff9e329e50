"""Typed methods for annotations say the same as the fields of the wire, and words are nodes."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import mapweave
from mapweave import MapId, NodeId, Pose2
from mapweave.hybridmap.annotation import Annotation, Closure, Floor, Place, Preference
from mapweave.hybridmap.errors import InvalidValue, MapweaveError, Refused
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.portal import Portal, PortalMeans
from mapweave.offline_record import OfflineRecord
from mapweave.opened_map import open_map
from mapweave.storage.plan_image import plan_file

FIRST, THIRD = NodeId("r0", 1, 1), NodeId("r1", 1, 3)


@pytest.fixture
def record(joined: Path, tmp_path: Path) -> OfflineRecord:
    return OfflineRecord(open_map(joined), tmp_path / "out.mapweave", "anna")


def last(record: OfflineRecord) -> Annotation:
    return record.annotations().made[-1]


def test_each_kind_has_a_method(record: OfflineRecord):
    record.place("kitchen", THIRD, because="the sink")
    assert last(record).body == Place(THIRD) and last(record).because == "the sink"
    record.place("hall", corners=[(0, 0), (1, 0), (1, 1)], near="kitchen")
    record.close_way(
        "wet floor", place="kitchen", radius=0.5, begin="2030-03-01 14:00", end="2030-03-01 15:00"
    )
    body = last(record).body
    assert isinstance(body, Closure) and body.area is not None and body.end_ns is not None
    assert body.begin_ns is not None and body.end_ns - body.begin_ns == 3600 * 10**9
    record.close_way("way", edge=(FIRST, "kitchen"))
    assert last(record).body == Closure((FIRST, THIRD))
    record.prefer("carpet", 0.5, node="kitchen", radius=1.0)
    assert isinstance(body := last(record).body, Preference) and body.factor == 0.5
    record.floor("kitchen", "ground")
    assert (last(record).name, last(record).words) == ("r1.1", "floor r1.1 is on floor ground, by anna")
    record.portal("gate", FIRST, "kitchen", "door", "the key is at the desk")
    assert last(record).words.startswith("portal gate is a door between r0.1.1 and r1.1.3 (the key is")
    record.pin("kitchen", Pose2(12.5, -3.0, 1.5))
    assert last(record).name == str(THIRD) and record.merged.pose(THIRD).distance(Pose2(12.5, -3.0)) < 1e-6
    image = record.put_plan_image(
        plan_file(cv2.imencode(".png", np.full((50, 40), 200, np.uint8))[1].tobytes(), "flat.png").png
    )
    at = record.merged.pose(THIRD)
    corners = ((0, 0), (4, 0), (4, 3), (0, 3))
    pairs = [(f"{at.x + x},{at.y + y}", 5.0 + 5 * x, 45.0 - 5 * y) for x, y in corners]
    record.plan("flat", image, pairs, metres_per_pixel=0.2, origin=Pose2(1.0, 2.0, 0.0))
    assert record.plans().plan("flat").part().rms < 1e-6


def test_a_check_keeps_nothing_and_a_field_that_there_is_not_is_found(record: OfflineRecord):
    """The type checker finds it, too: an ignored error that there is not would be one."""
    assert record.place("kitchen", THIRD, check=True).startswith("only checked, nothing is changed: place")
    with pytest.raises(TypeError, match="nodee"):
        record.place("kitchen", nodee=3)  # type: ignore[call-arg]
    with pytest.raises(Refused, match='"lift", "ramp" or "door"'):
        record.portal("gate", FIRST, THIRD, "stairs")  # type: ignore[arg-type]
    assert record.annotations().made == ()


def test_words_are_nodes_and_what_is_none_is_refused(joined: Path, record: OfflineRecord):
    room = mapweave.open(joined)
    for one in (room, record):
        assert one.resolve("r1.1.3").found[0].node == THIRD
        assert [found.node for found in one.resolve(["r1.1.3", "r0.1.1"]).found] == [THIRD, FIRST]
        with pytest.raises(Refused, match="'kitchen' is no place of this map"):
            one.resolve("kitchen")
        with pytest.raises(InvalidValue, match=r"3: give a node \(r0\.1\.17\)"):
            one.resolve(3)  # type: ignore[arg-type]


def test_a_position_is_two_numbers_wherever_a_node_stands(joined: Path, record: OfflineRecord):
    """Only text was taken: `(1.0, 2.0)` was asked for as the word "(1.0, 2.0)", or refused."""
    room = mapweave.open(joined)
    at = room.pose(THIRD).mean
    there = (at.x, at.y)
    for position in (there, np.array(there), (np.float32(at.x), at.y)):
        assert room.resolve(position).found[0].node == THIRD
        assert room.node(position).id == THIRD
    assert [found.node for found in record.resolve([there, "r0.1.1", FIRST]).found] == [THIRD, FIRST, FIRST]
    assert record.resolve(FIRST).found[0].node == FIRST
    assert room.explain(FIRST, there).reason == room.explain(FIRST, THIRD).reason
    way = room.route(there, FIRST, blocked=[(there, FIRST)], via=[there])
    assert way == room.route(THIRD, FIRST, blocked=[(THIRD, FIRST)], via=[THIRD]) and way.hops
    with pytest.raises(InvalidValue, match=r"`via` is a list, such as \[\(1\.0, 2\.0\)\]"):
        room.route(FIRST, THIRD, via=(1.0, 2.0))  # type: ignore[arg-type]
    for body, say in (
        (Place(THIRD), lambda: record.place("kitchen", there)),
        (Place(THIRD), lambda: record.annotate("place", "larder", node=there)),
        (Closure((FIRST, THIRD)), lambda: record.close_way("way", edge=(FIRST, there))),
        (Preference(0.5, (FIRST, THIRD)), lambda: record.prefer("way", 0.5, edge=(FIRST, there))),
        (Floor(THIRD, "ground"), lambda: record.floor(there, "ground")),
        (Portal(FIRST, THIRD, PortalMeans.DOOR), lambda: record.portal("gate", FIRST, there, "door")),
        (Pin(THIRD, Pose2(1.0, 2.0, 3.0)), lambda: record.pin(there, Pose2(1.0, 2.0, 3.0))),
    ):
        say()
        assert last(record).body == body
    said = room.retire(there, because="the wall is new", check=True)
    assert said == room.retire(THIRD, because="the wall is new", check=True)
    said = room.unlink(MapId("r0", 1), MapId("r1", 1), because="two rooms", check=True)
    assert said == room.unlink("r0.1", "r1.1", because="two rooms", check=True)
    for nothing in ((1.0, 2.0, 3.0), ("1", "2"), None, 3):
        with pytest.raises(MapweaveError, match="give a node"):
            room.node(nothing)  # type: ignore[arg-type]
    with pytest.raises(Refused, match="nothing is mapped within"):
        room.node((500.0, 2.0))


def test_a_refusal_says_what_this_annotation_takes(record: OfflineRecord):
    """A place was said to be an edge, a closure a node, and a time that is read as UTC local time."""
    edge = (FIRST, THIRD)
    with pytest.raises(Refused, match=r"^a place is a node or an area: give one of them$"):
        record.place("kitchen")
    for say in (
        lambda: record.close_way("paint"),
        lambda: record.prefer("paint", 0.5),
        lambda: record.close_way("paint", edge=edge, corners=[(0, 0), (1, 0), (1, 1)]),
    ):
        with pytest.raises(Refused, match=r"^a (closure|preference) is of an edge or an area: give one"):
            say()
    for say in (
        lambda: record.close_way("paint", node=FIRST),
        lambda: record.prefer("paint", 0.5, node=FIRST),
    ):
        with pytest.raises(Refused, match=r"has no `node` without `radius`, m, of the floor around it"):
            say()
    with pytest.raises(Refused, match=r"'yesterday' is no time: write 14:00, 2026-03-01 14:00 \(UTC\), "):
        record.close_way("paint", edge=edge, end="yesterday")
