"""A new map gets the next number, also after a robot has lost its disk."""

from contextlib import ExitStack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.replication.epochs import FOUR_DIGITS, LARGEST, newest_on_server, next_epoch
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.bus import Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import NewestMap
from mapweave.wire.memory import MemoryBus, MemoryHub

KEYS = Keys("test")


@given(st.sets(st.integers(1, LARGEST)), st.one_of(st.none(), st.integers(0, LARGEST)))
def test_the_number_is_new_and_short(taken: set[int], stored: int | None):
    epoch = next_epoch(taken, stored)
    assert epoch not in taken
    assert stored is None or epoch > stored
    known = taken | {stored or 0}
    assert epoch == max(known) + 1 or (not taken and stored is None and epoch in FOUR_DIGITS)


def test_two_robots_without_disk_and_server_draw_different_numbers():
    drawn = [next_epoch([], None) for _ in range(50)]
    assert len(set(drawn)) > 40


@given(st.integers(0, 2**53))
def test_the_answer_survives(epoch: int):
    assert NewestMap.decode(NewestMap(epoch).encode()) == NewestMap(epoch)


@pytest.mark.parametrize("payload", [b"", b"\x80", NewestMap(-1).encode(), NewestMap(2**60).encode()])
def test_a_broken_answer_is_refused(payload: bytes):
    with pytest.raises(InvalidMessage):
        NewestMap.decode(payload)


@pytest.fixture
def bus(hub: MemoryHub) -> MemoryBus:
    return MemoryBus(hub)


def test_a_server_reports_the_newest_map_on_its_disk(hub: MemoryHub, bus: MemoryBus, tmp_path):
    with ExitStack() as stack:
        store = SqliteStore(tmp_path / "s0.sqlite")
        stack.callback(store.close)
        for map_id in (MapId("r0", 3), MapId("r0", 12), MapId("r1", 40), MapId("r0", 7)):
            store.apply(map_id, 5, [], 0)
        there = MemoryBus(hub)
        stack.callback(there.close)
        ingest = Ingest(there, KEYS, store, "s0", lambda change: None)
        stack.callback(ingest.close)
        assert newest_on_server(bus, KEYS, "s0", "r0", 0.0) == 12
        assert newest_on_server(bus, KEYS, "s0", "r1", 0.0) == 40
        assert newest_on_server(bus, KEYS, "s0", "r9", 0.0) == 0
        assert newest_on_server(bus, KEYS, "s1", "r0", 0.0) is None


def test_nonsense_answers_are_ignored(hub: MemoryHub, bus: MemoryBus):
    lines = [b"\x00", NewestMap(LARGEST + 1).encode()]
    liar = MemoryBus(hub)

    def answer(request: Request) -> None:
        request.reply(lines[0])

    liar.serve(KEYS.all_acks("s0"), answer)
    while lines:
        assert newest_on_server(bus, KEYS, "s0", "r0", 0.0) is None
        lines.pop(0)
