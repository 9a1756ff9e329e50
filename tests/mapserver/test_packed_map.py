"""The whole map as an answer: it blocks no other question, and costs one pack a merge."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.query import RouteAnswer, RouteRequest
from mapweave.mapserver import packed_map
from mapweave.mapserver.server import MapServer
from mapweave.storage.map_file import unpack_map_file
from mapweave.wire.bus import Reply
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from tests.waiting import eventually

KEYS = Keys("fleet")
MAP = KEYS.server_map("s0")


class Served:
    """A server with a mapped room, whose packing can be held up."""

    def __init__(self, room, monkeypatch: pytest.MonkeyPatch) -> None:
        self.hub = MemoryHub()
        self.bus = MemoryBus(self.hub)
        self.server = MapServer(self.bus, KEYS, room.path, "s0")
        self.nodes = sorted(room.truth)
        self.go_on = threading.Event()
        self.go_on.set()
        self.packs = 0
        pack = packed_map.pack_map_file

        def slowly(content: object) -> bytes:
            self.packs += 1
            assert self.go_on.wait(30)
            return pack(content)

        monkeypatch.setattr(packed_map, "pack_map_file", slowly)

    def ask(self, key: str, payload: bytes = b"") -> Reply:
        bus = MemoryBus(self.hub)
        try:
            return bus.ask(key, payload, 30.0)[0]
        finally:
            bus.close()


@pytest.fixture
def served(mapped_room, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    served = Served(mapped_room(), monkeypatch)
    with served.server:
        assert served.server.settle(20)
        yield served
        served.go_on.set()
    served.bus.close()


def test_everything_else_is_answered_while_the_map_is_packed(served: Served):
    served.go_on.clear()
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(served.ask, MAP)
        eventually(lambda: served.packs == 1)
        begin = time.monotonic()
        assert decode_record(served.ask(KEYS.server_status("s0")).payload)["nodes"] == len(served.nodes)
        route = encode(RouteRequest(served.nodes[0], served.nodes[-1]))
        assert decode(served.ask(KEYS.route("s0"), route).payload, RouteAnswer).legs
        assert time.monotonic() < begin + 10.0 and not asked.done()
        served.go_on.set()
        assert unpack_map_file(asked.result(30).payload).kind == "merged"


def test_the_same_map_is_packed_once(served: Served):
    first = served.ask(MAP).payload
    assert served.ask(MAP).payload == first and served.packs == 1
    served.server._history.failed("something")
    answer = unpack_map_file(served.ask(MAP).payload).history
    assert served.packs == 2 and "something" in answer[-1].words


def test_a_crowd_costs_two_packs_at_most(served: Served, monkeypatch):
    served.go_on.clear()
    with ThreadPoolExecutor(20) as pool:
        asked = [pool.submit(served.ask, MAP)]
        eventually(lambda: served.packs == 1)
        asked += [pool.submit(served.ask, MAP) for _ in range(19)]
        services = served.server._services._map
        eventually(lambda: len(services._waiting) == 19)
        monkeypatch.setattr(packed_map, "MAX_WAITING", 19)
        refused = served.ask(MAP)
        assert refused.retry_after == pytest.approx(packed_map.PAUSE) and "busy" in refused.error
        served.go_on.set()
        assert len({item.result(30).payload for item in asked}) == 1
    assert served.packs <= 2


def test_a_map_that_cannot_be_packed_is_refused_and_the_next_is_not(served: Served, monkeypatch):
    with monkeypatch.context() as broken:

        def fail(*_: object) -> bytes:
            raise InvalidValue("too much")

        broken.setattr(packed_map, "map_file_of", fail)
        assert "too much" in served.ask(MAP).error
    assert not served.ask(MAP).error
