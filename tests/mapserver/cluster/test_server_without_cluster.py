"""A server whose cluster is not there does all by itself, and says why."""

import socket
import sys
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest

from mapweave.cli import main
from mapweave.hybridmap.query import Certainty
from mapweave.mapserver.cluster import gateway_process
from mapweave.mapserver.cluster.settings import ClusterSettings
from mapweave.mapserver.server import MapServer, ServerSettings
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapserver.house import MappedRoom
from tests.waiting import eventually, free_port


def test_the_server_needs_no_cluster(mapped_room: Callable[[], MappedRoom], caplog):
    room, bus = mapped_room(), MemoryBus(MemoryHub())
    nowhere = f"127.0.0.1:{free_port()}"
    settings = replace(ServerSettings(), cluster=ClusterSettings(nowhere, shards=2))
    with MapServer(bus, Keys("fleet"), room.path, "s0", settings) as server:
        eventually(lambda: server.status()["nodes"] == 7)
        eventually(lambda: f"nothing listens at {nowhere}" in caplog.text)
        assert server.status()["cluster"] == "0 of 2 shards; 2 in this process"
        answer = server.locate(lambda: room.view(next(iter(room.truth))), 1).result(30.0)
        assert answer.certainty is Certainty.FOUND and not answer.partial
    bus.close()


@pytest.mark.parametrize(("mode", "hinted"), [("", True), ("token", False)])
def test_a_cluster_that_refuses_a_server_may_want_a_token(monkeypatch, mode: str, hinted: bool):
    """Ray itself says only that it could not connect."""

    def init(**_: object) -> None:
        raise ConnectionError("Failed to connect to Ray cluster")

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    monkeypatch.setenv("RAY_AUTH_MODE", mode)
    with socket.create_server(("127.0.0.1", 0)) as head:
        with pytest.raises(ConnectionError, match="Failed to connect") as raised:
            gateway_process._joined(f"127.0.0.1:{head.getsockname()[1]}")
        assert ("RAY_AUTH_MODE=token" in str(raised.value)) is hinted


def test_lock_step_and_a_cluster_exclude_each_other(capsys):
    assert main(["server", "--lockstep", "--ray", "auto"]) == 2
    assert "--lockstep is repeatable, and a cluster is not" in capsys.readouterr().err
