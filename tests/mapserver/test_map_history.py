"""The history of the maps: each event once, with its date, and kept on the disk."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import History, MapEvent, MapEventKind
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.constraint_history import with_constraints
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.map_history import MOST_AT_ONCE, MapHistory
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.explanation.twin_maps import TWINS
from mapweave.merge.mutual_exclusion.collision import Collision, is_exclusion
from mapweave.merge.pose_graph.links import refuse
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.messages import KeptHistory, decode, encode
from mapweave.wire.packing import pack
from synthetic.maps import looked_around, merger_of

A, B = MapId("a", 1), MapId("b", 1)
APART = ManualConstraints([ManualConstraint(Apart((A, B)), True, "anna", 10**18, "two kitchens")])


@pytest.fixture(scope="module")
def merger() -> Merger:
    """Two robots have looked around in one room."""
    return merger_of(looked_around((A, B), seed=6))


@pytest.fixture(scope="module")
def one(merger: Merger) -> MergedMap:
    merger.constrain(ManualConstraints())
    return merger.merged()


@pytest.fixture(scope="module")
def two(merger: Merger) -> MergedMap:
    merger.constrain(APART)
    return merger.merged()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = SqliteStore(tmp_path / "s0.sqlite")
    yield store
    store.close()


def events(history: MapHistory) -> list[tuple[MapEventKind, str]]:
    return [(event.kind, event.words.split(":")[0].split(", by")[0]) for event in history.events]


JOINED = (MapEventKind.JOINED, "a.1 and b.1 are one map now")
PARTED = (MapEventKind.PARTED, "a.1 and b.1 are no longer one map")


def test_each_event_is_listed_once_with_its_time(one: MergedMap, two: MergedMap):
    times = iter(range(10**18, 10**19, 10**9))
    history = MapHistory(clock=lambda: next(times))
    for merged in (MergedMap.empty(), one, one, two, two, one):
        history.follow(merged)
    assert events(history) == [JOINED, PARTED, JOINED]
    assert "two kitchens" in history.events[1].words and history.newest.startswith("a.1 and b.1")
    stamps = [event.stamp_ns for event in history.events]
    assert stamps == sorted(stamps) and stamps[0] >= 10**18


def test_a_restarted_server_publishes_only_news(store: Store, one: MergedMap, two: MergedMap):
    MapHistory(store).follow(one)
    again = MapHistory(store)
    # It merges before it has read its store if manual constraints come first.
    again.follow(MergedMap.empty())
    again.follow(one)
    assert events(again) == [JOINED]
    third = MapHistory(store)
    third.follow(two)
    assert events(third) == [JOINED, PARTED]
    assert "refused (undone with all links between a.1 and b.1 by anna" in third.newest
    assert MapHistory(store).events == third.events


def test_it_is_bounded(store: Store, one: MergedMap, two: MergedMap):
    history = MapHistory(store, most=5)
    for k in range(12):
        history.follow(two if k % 2 else one)
    assert events(history) == [PARTED, JOINED, PARTED, JOINED, PARTED] == events(MapHistory(store))


def test_many_events_at_once_are_summarised(one: MergedMap):
    many = {MapId(f"r{k}", 1): one.maps[A] for k in range(200)}
    nodes = frozenset(next(iter(one.maps[A].nodes))._replace(agent=name.agent) for name in many)
    history = MapHistory()
    history.follow(replace(one, maps=many, links=(), components=(nodes,)))
    assert len(history.events) == MOST_AT_ONCE + 1
    assert history.newest == f"and {199 - MOST_AT_ONCE} more at once"


def test_mutual_exclusion_is_reported_until_the_maps_are_joined(store: Store, one: MergedMap, two: MergedMap):
    clash = Collision("a", "b", "hall", 40, 0.1, 12.0, 99.0)
    seen = replace(clash, where="ahead")
    assert is_exclusion(clash.reason) and is_exclusion(seen.reason)
    links = [link for link in one.links if {link.a.map, link.b.map} == {A, B}]
    held = replace(two, refused=tuple(refuse(link, clash.reason) for link in links))
    history = MapHistory(store)
    history.follow(held)
    history.follow(replace(two, refused=tuple(refuse(link, seen.reason) for link in links)))
    ((kind, _),) = events(history)
    assert kind is MapEventKind.KEPT_APART
    # What people can do about it is said where several nodes of each map show the same places.
    assert history.newest == (
        f"a.1 and b.1 are kept apart: {len(links)} links refused ({clash.reason}). "
        f"They show the same places: {TWINS}"
    )
    again = MapHistory(store)
    again.follow(held)
    assert again.events == history.events, "recorded already"
    again.follow(one)
    again.follow(held)
    # The split by it has the reason itself.
    assert [kind for kind, _ in events(again)] == [
        MapEventKind.KEPT_APART,
        MapEventKind.JOINED,
        MapEventKind.PARTED,
    ]
    assert "same place at the same time" in again.newest


def test_each_refused_pair_is_listed_once(one: MergedMap, monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.map_history.MOST_APART", 3)
    (link, *_) = (link for link in one.links if {link.a.map, link.b.map} == {A, B})
    names = [MapId(f"r{k}", 1) for k in range(6)]
    reason = Collision("a", "b", "hall", 40, 0.1, 12.0, 99.0).reason
    refused = tuple(
        refuse(replace(link, a=link.a._replace(agent="r0"), b=link.b._replace(agent=name.agent)), reason)
        for name in names[1:]
    )
    parts = tuple(frozenset([link.a._replace(agent=name.agent)]) for name in names)
    merged = MergedMap(dict.fromkeys(names, one.maps[A]), (), refused, parts, {})
    history = MapHistory()
    for _ in range(3):
        history.follow(merged)
    assert [kind for kind, _ in events(history)] == [MapEventKind.KEPT_APART] * 3


def test_maps_without_nodes_have_no_history(merger: Merger, one: MergedMap):
    other = Merger()
    for map_id in (A, B):
        for change in one.maps[map_id].contents():
            other.apply(map_id, change)
    history = MapHistory()
    history.follow(other.merged())
    for node in list(one.maps[B].nodes):
        other.apply(B, NodeRetired(node))
    history.follow(other.merged())
    assert events(history) == [JOINED]


def test_a_damaged_record_is_replaced_and_reported(store: Store, one: MergedMap):
    store.put_result("history", b"rubbish")
    history = MapHistory(store)
    (failed,) = history.events
    assert failed.kind is MapEventKind.FAILED and "damaged" in failed.words and history.newest == ""
    history.failed(failed.words)
    assert history.events == (failed,), "recorded once"
    history.follow(one)
    assert MapHistory(store).events == history.events


def test_a_disk_that_does_not_take_it_ends_nothing(tmp_path, one: MergedMap, two: MergedMap, caplog):
    store = SqliteStore(tmp_path / "s0.sqlite")
    history = MapHistory(store)
    history.follow(one)

    def full(name: str, value: bytes, known: object) -> bool:
        raise InvalidFile("the disk is full")

    store.replace_result = full  # type: ignore[method-assign]
    history.follow(two)
    assert events(history) == [JOINED, PARTED] and "is not kept: the disk is full" in caplog.text
    store.close()
    store = SqliteStore(tmp_path / "s0.sqlite")
    assert events(MapHistory(store)) == [JOINED], "the record of before is whole"
    store.close()


def test_constraints_are_listed_in_the_history():
    events = [MapEvent(10**18 + k, MapEventKind.JOINED, "x") for k in (-1, 1)]
    kinds = [event.kind for event in with_constraints(events, APART)]
    assert kinds == [MapEventKind.JOINED, MapEventKind.CONSTRAINED, MapEventKind.JOINED]
    assert "two kitchens" in with_constraints((), APART)[0].words


def test_it_comes_through_bytes():
    events = (MapEvent(5, MapEventKind.PARTED, "a and b"), MapEvent(6, MapEventKind.FAILED, "no"))
    assert decode(encode(History(events)), History).history == events
    kept = KeptHistory(events, (frozenset([A, B]), frozenset([MapId("c", 2)])), frozenset([(A, B)]))
    assert decode(encode(kept), KeptHistory) == kept
    with pytest.raises(InvalidValue, match="printable"):
        encode(History((MapEvent(5, MapEventKind.PARTED, "two\nlines"),)))
    newer = [
        {"stamp_ns": 1, "kind": "danced", "words": "x"},
        {"stamp_ns": 6, "kind": "failed", "words": "no"},
    ]
    assert decode(pack({"history": newer}), History).history == events[1:]
    wrong: list[object] = [
        [{"stamp_ns": 1, "kind": "joined"}],
        [{**newer[1], "kind": 2}],
        5,
        [[1, "joined", "x"]],
    ]
    for fields in ({}, *({"history": item} for item in wrong)):
        with pytest.raises(InvalidMessage):
            decode(pack(fields), History)


def test_a_pinned_frame_that_moves_is_listed_with_its_change(merger: Merger, store: Store):
    history = MapHistory(store)
    older, newer = (
        Pin(min(merger.maps[B].nodes), Pose2(3.0, 4.0, 1.0)),
        Pin(min(merger.maps[A].nodes), Pose2()),
    )
    merger.pin([older, newer])
    for constraints in (APART, ManualConstraints(), ManualConstraints(), APART):
        merger.constrain(constraints)
        merged = merger.merged()
        history.follow(merged)
        if constraints is not APART:
            change = merged.pose(newer.node)
            # A server that starts again does not report it again.
            history = MapHistory(store)
    merger.pin([])
    history.follow(merger.merged())
    words = [event.words for event in history.events if event.kind is MapEventKind.FRAME]
    turn = f"turned by {math.degrees(change.heading):.2f} deg about the origin"
    shift = f"then shifted by {change.x:.3f}, {change.y:.3f} m"
    assert len(words) == 2 and turn in words[0] and shift in words[0] and str(older.node) in words[0]
    assert words[1] == f"the pin of {newer.node} holds its component's frame again"
