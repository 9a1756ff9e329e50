"""A map server that starts again: its page has the map of before at once."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import takewhile
from urllib.request import urlopen

import pytest
from websockets.sync.client import connect

from mapweave import MapFile, MapId, write_map_file
from mapweave.agent.replication.journal import Journal
from mapweave.commands.server import summary_of
from mapweave.mapserver.http.live import LOADING, NOT_THERE
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.log_messages import Scalar
from synthetic.maps import looked_around
from tests.programs import going
from tests.waiting import eventually, free_port


@contextmanager
def server(http: int, *arguments: str) -> Iterator[None]:
    command = [
        sys.executable, "-m", "mapweave", "server", "--http", str(http), "--listen",
        f"tcp/127.0.0.1:{free_port()}", *arguments,
    ]  # fmt: skip
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=dict(os.environ))
    try:
        yield
    finally:
        running.send_signal(signal.SIGINT)
        assert running.wait(30) == 0


class Started:
    """A server that has read its store, and has merged or not."""

    def __init__(self, nodes: int, merged: bool) -> None:
        self.nodes, self.merged = nodes, merged

    def status(self) -> dict[str, Scalar]:
        summary = f"{self.nodes} nodes, 2 maps, 2 components, 0 links, 0 refused"
        return {"summary": summary, "nodes": self.nodes, "merged": self.merged}


@pytest.mark.parametrize(("nodes", "merged", "said"), [(9, False, True), (9, True, False), (0, False, False)])
def test_the_log_says_that_maps_are_not_merged_yet(nodes: int, merged: bool, said: bool):
    """The first line after a start was that of maps without any link, as if they had come apart."""
    words = summary_of(Started(nodes, merged))  # type: ignore[arg-type]
    assert words.endswith(", still merging") == said


def first_messages(http: int) -> dict[str, dict]:
    """The first message of each kind of the page's WebSocket, once the port is open."""
    messages: dict[str, dict] = {}

    def ask() -> bool:
        try:
            with connect(f"ws://127.0.0.1:{http}/live", proxy=None) as socket:
                while not {"map", "state"} <= messages.keys():
                    message = json.loads(socket.recv(timeout=20))
                    messages.setdefault(message["kind"], message)
        except OSError:
            return False
        return True

    eventually(ask, 60)
    return messages


@pytest.mark.slow
def test_the_page_shows_the_map_of_before_while_the_server_loads(tmp_path):
    http = free_port()
    for map_id, log in looked_around((MapId("r0", 1), MapId("r1", 1)), seed=4).items():
        write_map_file(tmp_path / f"{map_id}.mapweave", MapFile("agent", str(map_id), tuple(log)))
    data = ["--data", str(tmp_path / "data"), "--map", str(tmp_path / "r0.1.mapweave")]

    def settled() -> bool:
        try:
            with urlopen(f"http://127.0.0.1:{http}/status", timeout=10) as reply:
                return bool(json.load(reply)["settled"])
        except OSError:
            return False

    with server(http, *data):
        begun = first_messages(http)
        assert begun["state"]["server"] == {"summary": LOADING, "loading": True}
        eventually(settled, 60)
    with server(http, *data):
        again = first_messages(http)
        assert again["state"]["server"] == {"summary": NOT_THERE, "loading": True}
        (component,) = again["map"]["components"]
        assert component["maps"] == ["r0.1"]
        eventually(settled, 60)
    kept = tmp_path / "data" / "s0.sqlite.shown"
    kept.write_bytes(kept.read_bytes()[:-5])
    with server(http, *data):
        assert first_messages(http)["state"]["server"]["summary"] == LOADING, "what was kept is damaged"


SLOW_START = """
import sys, time
from mapweave.cli import main
from mapweave.mapserver.server import MapServer

def read_a_large_store(server):
    print("reading", flush=True)
    time.sleep(600.0)

MapServer.__enter__ = read_a_large_store
sys.exit(main(sys.argv[1:]))
"""


def starting_slowly(*arguments: object) -> AbstractContextManager[subprocess.Popen[str]]:
    """A server that reads for ten minutes, whose output is read."""
    program = [sys.executable, "-c", SLOW_START, "server", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    return going(*program, *arguments, stdout=subprocess.PIPE, env=dict(os.environ), text=True)


def test_a_server_that_reads_its_store_can_be_stopped(tmp_path):
    with starting_slowly("--data", tmp_path) as running:
        assert any("reading" in line for line in running.stdout)
        running.send_signal(signal.SIGTERM)
        assert "stopped while it was starting" in running.stdout.read()
        assert running.wait(60) == 0


ANSWER_IN_TWO_PARTS = """
import asyncio, threading
from mapweave.commands.server import end_if_stopped_before
from mapweave.mapserver.http.serving import HttpThread

BODY = b"the second part"

async def app(scope, receive, send):
    length = [(b"content-length", str(len(BODY)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": length})
    stop.set()
    await asyncio.sleep(0.3)
    await send({"type": "http.response.body", "body": BODY})

stop, web = threading.Event(), HttpThread(app, ("127.0.0.1", 0))
end_if_stopped_before(stop, close=web.close)
print(web.port, flush=True)
threading.Event().wait()
"""


def test_a_server_that_is_stopped_while_it_starts_ends_the_answers_that_it_has_begun():
    """A page that asked in that moment got the head of an answer without its content."""
    command = [sys.executable, "-c", ANSWER_IN_TWO_PARTS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        with urlopen(f"http://127.0.0.1:{int(running.stdout.readline())}/", timeout=20) as reply:
            assert reply.read() == b"the second part"
        assert running.wait(20) == 0


def test_a_server_that_begins_a_store_beside_those_of_others_says_so(tmp_path):
    """As after a restore under another name: it began with nothing, and did not say so."""
    SqliteStore(tmp_path / "monday.sqlite").close()
    Journal(tmp_path / "r0.sqlite", "r0").close()
    said = {}
    for name in ("s1", "monday"):
        with starting_slowly("--name", name, "--data", tmp_path) as running:
            said[name] = "".join(takewhile(lambda line: "reading" not in line, running.stdout))
    assert f"{tmp_path / 's1.sqlite'} is a new store, with nothing in it" in said["s1"]
    assert "and not with monday.sqlite beside it\n" in said["s1"]
    assert "a new store" not in said["monday"]
