"""A metered bus does what the bus does, and its count is the sum of what the other side saw."""

import pytest

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.traffic_meter import TrafficMeter
from tests.waiting import eventually


@pytest.fixture
def pair(hub: MemoryHub) -> tuple[MemoryHub, TrafficMeter, MemoryBus]:
    return hub, TrafficMeter(MemoryBus(hub)), MemoryBus(hub)


def test_published_messages_are_received(pair):
    _, metered, other = pair
    received, seen = [], []
    other.subscribe("to/other", received.append)
    metered.subscribe("to/metered", seen.append)
    metered.publish("to/other", b"12345", b"678")
    assert metered.traffic == len("to/other") + 5 + 3
    other.publish("to/metered", b"1234", b"56")
    eventually(lambda: seen and received)
    assert seen[0].payload == b"1234"
    assert received[0].attachment == b"678"
    assert metered.traffic == len("to/other") + 8 + len("to/metered") + 6


def test_questions_in_both_directions(pair):
    _, metered, other = pair
    metered.serve("ask/metered", lambda request: request.reply(request.payload * 2))

    def refuse(request) -> None:
        raise InvalidMessage("no such thing")

    other.serve("ask/other", refuse)
    assert other.ask("ask/metered", b"abc", 2.0)[0].payload == b"abcabc"
    assert metered.traffic == len("ask/metered") + 3 + 6
    before = metered.traffic
    (reply,) = metered.ask("ask/other", b"abc", 2.0)
    assert reply.error == "no such thing"
    assert metered.traffic == before + len("ask/other") + 3 + len(reply.error)


def test_without_a_connection_nothing_is_counted(pair):
    hub, metered, _ = pair
    hub.cut(metered._bus)
    assert not metered.connected()
    metered.publish("to/other", b"12345")
    assert metered.ask("ask/other", b"abc", 0.05) == []
    assert metered.traffic == 0
