"""Several routers: what a client does when one is dead, and fleets that are spread over some."""

import json
import os
import socket
import subprocess
import sys
import time

import pytest
import zenoh

from mapweave.hybridmap.errors import SettingsError
from mapweave.wire.bus_settings import NEXT_ENDPOINT, BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from mapweave.wire.zenoh_config import LARGEST, LARGEST_MESSAGE, router_file
from tests.waiting import eventually, free_port
from tests.wire.fleets import Routers, endpoint


def answers(server: ZenohBus, word: bytes) -> None:
    server.serve("mapweave/who", lambda request: request.reply(word))


def answered(client: ZenohBus) -> set[bytes]:
    return {reply.payload for reply in client.ask("mapweave/who", b"", 5.0)}


def silent() -> socket.socket:
    """A port whose host takes connections and says nothing, as a frozen router does."""
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen()
    return listening


def unreachable() -> tuple[socket.socket, list[socket.socket]]:
    """A port that drops what is sent to it, as a host does that is switched off: its queue is full."""
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen(0)
    waiting = [socket.socket() for _ in range(3)]
    for one in waiting:
        one.setblocking(False)
        one.connect_ex(listening.getsockname())
    return listening, waiting


@pytest.mark.slow
def test_a_dead_first_router_does_not_hold_up_the_start(routers: Routers):
    alive = free_port()
    routers.router(alive)
    frozen, (off, waiting) = silent(), unreachable()
    for dead in (free_port(), frozen.getsockname()[1], off.getsockname()[1]):
        begin = time.monotonic()
        assert routers.client(dead, alive).wait_connected(30)
        # Zenoh's own patience is 10 s.
        assert time.monotonic() - begin < 8.0 > 2 * NEXT_ENDPOINT
    for one in (frozen, off, *waiting):
        one.close()


def test_a_client_goes_to_the_next_router_and_back(routers: Routers):
    first, second = free_port(), free_port()
    one = routers.router(first)
    answers(one, b"first")
    client = routers.client(first, second)
    eventually(lambda: answered(client) == {b"first"})
    answers(routers.router(second), b"second")
    one.close()
    eventually(lambda: answered(client) == {b"second"})
    answers(routers.router(first), b"first")
    routers.open[-2].close()
    eventually(lambda: answered(client) == {b"first"})


def test_routers_that_join_each_other_carry_everything(routers: Routers):
    """Agent - router - router - server; the order in which they start does not matter."""
    agents, between, servers = (free_port() for _ in range(3))
    # Its neighbour is not there yet.
    routers.router(between, agents)
    agent = routers.client(agents)
    server = routers.router(servers, between)
    alive: list[tuple[str, bool]] = []
    got: list[bytes] = []
    agent.watch("mapweave/alive/*", lambda key, is_alive: alive.append((key, is_alive)))
    server.announce("mapweave/alive/s0")
    server.subscribe("mapweave/change", lambda sample: got.append(sample.payload))
    answers(server, b"server")
    routers.router(agents)
    eventually(lambda: answered(agent) == {b"server"})
    eventually(lambda: alive == [("mapweave/alive/s0", True)])
    eventually(lambda: agent.publish("mapweave/change", bytes(10_000)) or got)
    assert set(got) == {bytes(10_000)}
    server.close()
    eventually(lambda: alive[-1] == ("mapweave/alive/s0", False))


def test_a_router_joins_one_other():
    with pytest.raises(SettingsError, match="a router joins one other, not 2"):
        BusSettings(mode="router", listen=(endpoint(1),), routers=(endpoint(2), endpoint(3)))


def test_what_is_too_large_between_routers_is_dropped_and_the_link_stays(routers: Routers):
    here, there = free_port(), free_port()
    routers.router(here)
    server, client = routers.router(there, here), routers.client(here)
    server.serve("mapweave/map", lambda request: request.reply(bytes(int(request.payload))))

    def size(wanted: int) -> list[int]:
        return [len(reply.payload) for reply in client.ask("mapweave/map", str(wanted).encode(), 20.0)]

    eventually(lambda: size(9) == [9])
    assert size(LARGEST["reply"] - 1000) == [LARGEST["reply"] - 1000]
    assert size(LARGEST["reply"] + 1) == []
    assert size(LARGEST_MESSAGE + 1000) == []
    assert size(9) == [9]


def test_the_printed_configuration_is_the_whole_configuration(routers: Routers, tmp_path):
    """A zenohd takes this file: Zenoh reads it, and a router by it joins another and carries messages."""
    here, there = free_port(), free_port()
    listen, join = endpoint(here), endpoint(there)
    printed = subprocess.run(
        [sys.executable, "-m", "mapweave", "router", "--print-config", "--listen", listen, "--connect", join],
        check=True, capture_output=True, text=True, timeout=60, env=dict(os.environ),
    ).stdout  # fmt: skip
    assert printed == router_file(BusSettings(mode="router", listen=(listen,), routers=(join,))) + "\n"
    path = tmp_path / "router.json5"
    path.write_text(printed)
    config = zenoh.Config.from_file(path)
    transport = json.loads(config.get_json("transport"))
    assert transport["shared_memory"]["enabled"] is False
    assert transport["link"]["rx"]["max_message_size"] == LARGEST_MESSAGE
    limits = {rule["id"]: rule["size_limit"] for rule in json.loads(config.get_json("low_pass_filter"))}
    assert limits == LARGEST
    session = zenoh.open(config)
    try:
        answers(routers.router(there), b"through")
        client = routers.client(here)
        eventually(lambda: answered(client) == {b"through"})
    finally:
        session.close()  # type: ignore[no-untyped-call]
