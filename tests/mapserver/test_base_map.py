"""A server with a map from the start: robots begin anywhere, and their maps join it."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from mapweave.agent.replication.epochs import newest_on_server
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.annotation import Annotation, Annotations, Place
from mapweave.hybridmap.change import ChangeBody, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.query import ResolveRequest
from mapweave.mapserver.base_map import BaseMap
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.server import MapServer
from mapweave.offline_merge import merge_parts
from mapweave.wire.codec import encode_body
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.maps import looked_around
from tests.waiting import eventually

KEYS = Keys("base")
R0, R1, R2 = MapId("r0", 4), MapId("r1", 1), MapId("r2", 1)
JOINED = MapEvent(7, MapEventKind.JOINED, "r0.4 and r1.1 are one map now")


LOGS = looked_around((R0, R1, R2), seed=8)
BASE = BaseMap("office.mapweave", {map_id: HybridMap(LOGS[map_id]) for map_id in (R0, R1)}, history=(JOINED,))


@contextmanager
def serving(folder: Path, base: BaseMap | None) -> Iterator[tuple[MapServer, MemoryHub]]:
    hub = MemoryHub()
    with MapServer(MemoryBus(hub), KEYS, folder / "s0.sqlite", "s0", base=base) as server:
        assert server.settle(60)
        yield server, hub


@contextmanager
def robot(hub: MemoryHub, folder: Path, map_id: MapId, changes: list[ChangeBody]) -> Iterator[Replicator]:
    """An agent that sends its map."""
    with ExitStack() as stack:
        journal = Journal(folder / f"{map_id.agent}.sqlite", map_id.agent)
        stack.callback(journal.close)
        journal.open_map(map_id.epoch)
        sender = Replicator(MemoryBus(hub), KEYS, journal, map_id)
        stack.callback(sender.close)
        sender.submit(changes, 0)
        yield sender


def contents(server: MapServer) -> dict[MapId, list[bytes]]:
    return {
        map_id: sorted(map(encode_body, hybrid.contents())) for map_id, hybrid in server.merged().maps.items()
    }


def wanted(*maps: MapId) -> dict[MapId, list[bytes]]:
    return {map_id: sorted(map(encode_body, LOGS[map_id])) for map_id in maps}


def test_a_small_base_map_in_words():
    (first, *_) = [body for body in LOGS[R0] if isinstance(body, NodePut)]
    assert str(BaseMap("a.mapweave", {R0: HybridMap([first])})) == "a.mapweave: 1 node of 1 map"


def test_a_robot_that_begins_anywhere_joins_the_map_that_is_there(tmp_path):
    with serving(tmp_path, BASE) as (server, hub):
        assert contents(server) == wanted(R0, R1) and server.status()["components"] == 1
        assert JOINED in server.history()
        with robot(hub, tmp_path, R2, LOGS[R2]):
            eventually(lambda: server.status()["nodes"] == 12 and server.status()["components"] == 1)
        eventually(lambda: contents(server) == wanted(R0, R1, R2))
        together = server.merged()
    # The base is read again, what came is in the store, and nothing of either is doubled.
    with serving(tmp_path, BASE) as (server, _):
        assert contents(server) == wanted(R0, R1, R2)
        assert [one.pair for one in server.merged().links] == [one.pair for one in together.links]
    # A file of all of it beside the store that has a part of it.
    whole = BaseMap.of("whole.mapweave", map_file_of(together, [JOINED]))
    with serving(tmp_path, whole) as (server, _):
        assert contents(server) == wanted(R0, R1, R2)
        assert [event.words for event in server.history()].count(JOINED.words) == 1
    with serving(tmp_path, None) as (server, _):
        assert contents(server) == wanted(R2), "the store has what robots have sent, and no more"


def test_a_robot_goes_on_with_its_map_of_the_base(tmp_path):
    newer = [*LOGS[R0], NodeRetired(NodeId(*R0, 7))]
    with serving(tmp_path, BASE) as (server, hub), robot(hub, tmp_path, R0, newer):
        eventually(lambda: server.status()["nodes"] == 7)
        left = HybridMap(newer)
        assert contents(server)[R0] == sorted(map(encode_body, left.contents()))
    # Of the file and the store the newer state counts: the file's node 7 is retired.
    with serving(tmp_path, BASE) as (server, _):
        assert contents(server)[R0] == sorted(map(encode_body, left.contents()))
    # A file that is newer than the store.
    more = BaseMap("more.mapweave", {R0: HybridMap([*LOGS[R0], *renumbered(LOGS[R0], 100)])})
    with serving(tmp_path, more) as (server, _):
        assert len(server.merged().maps[R0].nodes) == 8


def renumbered(changes: list[ChangeBody], by: int) -> list[ChangeBody]:
    return [
        NodePut(replace(body.node, id=NodeId(*body.node.id.map, body.node.id.number + by)))
        for body in changes
        if isinstance(body, NodePut)
    ]


def test_another_map_of_the_same_name_is_refused_and_the_base_stays(tmp_path):
    other = [
        NodePut(replace(body.node, stamp_ns=body.node.stamp_ns + 1))
        for body in LOGS[R0]
        if isinstance(body, NodePut)
    ]
    with serving(tmp_path, BASE) as (server, hub):
        bus = MemoryBus(hub)
        assert newest_on_server(bus, KEYS, "s0", "r0", 5.0) == 4, "a robot that asks takes another number"
        with robot(hub, tmp_path, R0, other) as sender:
            eventually(lambda: "another map goes by the name r0.4 here" in sender.status().failure)
        assert contents(server) == wanted(R0, R1)
    with serving(tmp_path, None) as (server, hub), robot(hub, tmp_path, R0, []):
        eventually(lambda: server.status()["nodes"] == 4)
    with pytest.raises(InvalidFile, match=r"r0\.4 is in office\.mapweave and in the store"):
        MapServer(MemoryBus(MemoryHub()), KEYS, tmp_path / "s0.sqlite", "s0", base=BASE)
    with serving(tmp_path, None) as (server, _):
        assert server.status()["nodes"] == 4, "the store is free again"


def test_constraints_and_annotations_of_the_base_hold(tmp_path):
    apart = ManualConstraint(Apart((R0, R1)), True, "anna", 5, "two kitchens")
    kitchen = Annotation("kitchen", Place(NodeId(*R0, 3)), False, "anna", 6)
    content = map_file_of(merge_parts(BASE.maps, ManualConstraints([apart])), (), Annotations((kitchen,)))
    with serving(tmp_path, BaseMap.of("apart.mapweave", content)) as (server, _):
        assert server.status()["components"] == 2 and server.status()["constraints"] == 1
        assert server.resolve(ResolveRequest(("kitchen",))).found[0].node == NodeId(*R0, 3)
        assert [event.words for event in server.history()] == [
            'r0.4 and r1.1: undone with all links between r0.4 and r1.1 by anna on 1970-01-01 00:00 UTC: '
            '"two kitchens"',
            "place kitchen is node r0.4.3, by anna",
        ]  # fmt: skip
