"""A server whose store no other has names the others of its fleet, each once."""

from contextlib import closing

from mapweave.processes.separate_stores import SeparateStores
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.waiting import eventually


def test_another_server_is_named_once(caplog):
    hub, keys = MemoryHub(), Keys("fleet")
    with closing(MemoryBus(hub)) as own, closing(MemoryBus(hub)) as other:
        own.announce(keys.server_alive("s0"))
        first = other.announce(keys.server_alive("s1"))
        other.announce(Keys("another").server_alive("s7"))
        with closing(SeparateStores(own, keys, "s0")):
            eventually(lambda: caplog.messages)
            first.close()
            other.announce(keys.server_alive("s1"))
            other.announce(keys.server_alive("s2"))
            eventually(lambda: len(caplog.messages) > 1)
    assert [message.split()[2] for message in caplog.messages] == ["s1", "s2"]
    assert all("does not reach the other" in message for message in caplog.messages)
