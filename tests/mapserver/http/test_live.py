"""The WebSocket of the page, with a client of another library than the server's."""

import asyncio
import base64
import json
import math
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.annotation import Annotation, Annotations, Floor
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.http import live
from mapweave.mapserver.http.live import MOST_VIEWERS, LiveUpdates
from mapweave.mapserver.http.login import RequestAuthorization
from mapweave.mapserver.http.row_table import RowTable
from mapweave.mapserver.http.serving import MAX_VIEWER_BYTES, ConnectionTimeouts
from mapweave.mapserver.http.web import Web
from mapweave.merge.outlier_rejection.link_probability import link_probabilities
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from tests.mapserver.stub_services import StubServices, two_maps
from tests.waiting import eventually

HANDSHAKE = (
    b"GET /live HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
TYPES = {
    "rows": "<u4", "map": "<u4", "number": "<f8", "x": "<f4", "y": "<f4", "heading": "<f4",
    "component": "<u4", "state": "u1", "a": "<u4", "b": "<u4", "kind": "u1", "probability": "<f4",
}  # fmt: skip


class Viewer:
    """Reads messages as docs/http.md says, and keeps the state that they give."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.tables: dict[str, dict[str, np.ndarray]] = {"nodes": {}, "edges": {}}
        self.last: dict[str, dict[str, Any]] = {}

    def until(self, kind: str) -> dict[str, Any]:
        while True:
            message = json.loads(self.connection.recv(timeout=20))
            self.last[message["kind"]] = message
            if message["kind"] == "map":
                for name, table in self.tables.items():
                    self._take(table, message[name], message["whole"])
            if message["kind"] == kind:
                return message

    def _take(self, table: dict[str, np.ndarray], sent: dict[str, Any], whole: bool) -> None:
        columns = {
            name: np.frombuffer(base64.b64decode(text), TYPES[name])
            for name, text in sent.items()
            if name != "count"
        }
        rows = np.arange(sent["count"]) if whole else columns.pop("rows")
        for name, values in columns.items():
            fresh = np.zeros(sent["count"], TYPES[name])
            if not whole:
                fresh[: len(table[name])] = table[name]
            fresh[rows] = values
            table[name] = fresh

    def nodes(self) -> dict[str, tuple[float, ...]]:
        table, maps = self.tables["nodes"], self.last["map"]["maps"]
        columns = (
            table[name].tolist() for name in ("map", "number", "x", "y", "heading", "component", "state")
        )
        return {
            f"{maps[m]}.{int(number)}": (*pose, state)
            for m, number, *pose, state in zip(*columns, strict=True)
            if state
        }

    def links(self) -> dict[frozenset[str], float]:
        names = list(self._names())
        table, kinds = self.tables["edges"], self.last["map"]["kinds"]
        columns = (table[name].tolist() for name in ("a", "b", "kind", "probability"))
        return {
            frozenset((names[a], names[b])): probability
            for a, b, kind, probability in zip(*columns, strict=True)
            if kinds[kind] in ("merged", "loop")
        }

    def _names(self) -> Iterator[str]:
        table, maps = self.tables["nodes"], self.last["map"]["maps"]
        for m, number in zip(table["map"].tolist(), table["number"].tolist(), strict=True):
            yield f"{maps[m]}.{int(number)}"


@contextmanager
def viewer(served: Web, **headers: str) -> Iterator[Viewer]:
    address = f"ws://127.0.0.1:{served.port}/live"
    with connect(address, additional_headers=headers, max_size=2**26) as connection:
        yield Viewer(connection)


def expected(merged: MergedMap) -> dict[str, tuple[float, ...]]:
    out = {}
    for node in merged.poses:
        pose = merged.pose(node)
        state = 2 if node in merged.superseded else 1
        out[str(node)] = (pose.x, pose.y, pose.heading, merged.component_of(node), state)
    return out


def same(left: dict[str, tuple[float, ...]], right: dict[str, tuple[float, ...]]) -> bool:
    return left.keys() == right.keys() and all(np.allclose(left[k], right[k], atol=1e-3) for k in left)


def less(merged: MergedMap) -> MergedMap:
    """The same map without its smaller half, and one node superseded."""
    graph = merged.graphs[0]
    kept = tuple(node for node in graph.nodes if node.agent == "r0")
    means = np.add(graph.means[: len(kept)], [5.0, 0.0, 0.0])
    superseded = {kept[1]: Superseded(kept[0], 9, 0.1, 0.1)}
    graph = PoseGraph(kept[0], kept, means, sparse.identity(3 * len(kept), format="csc"))
    return replace(merged, graphs=(graph,), links=(), superseded=superseded)


def test_a_viewer_gets_the_map_and_what_changes(served: Web, services: StubServices):
    services.events = (MapEvent(10**18, MapEventKind.JOINED, "r0.1 and r1.1 are one map now"),)
    merged = two_maps()
    with viewer(served) as first:
        assert first.until("hello") == {
            "kind": "hello", "name": "", "role": "", "read_only": False, "commands": True, "why_not": ""
        }  # fmt: skip
        assert first.until("map")["whole"]
        assert same(first.nodes(), expected(merged))
        (component,) = first.last["map"]["components"]
        maps = ["r0.1", "r1.1"]
        assert component == {"anchor": "r0.1.1", "nodes": len(merged.poses), "maps": maps, "floor": ""}
        (event,) = first.until("events")["history"]
        assert event["kind"] == "joined" and event["words"].startswith("r0.1 and r1.1")
        assert set(first.links()) == {frozenset(map(str, link.pair)) for link in merged.links}
        while not all(math.isfinite(p) for p in first.links().values()):
            assert not first.until("map")["whole"]
        for pair, probability in link_probabilities(merged).items():
            assert first.links()[frozenset(map(str, pair))] == pytest.approx(probability)
        services.map = less(merged)
        moved = {
            name: (row[0] + 5.0, *row[1:-1], 2 if name == "r0.1.3" else 1)
            for name, row in expected(merged).items()
            if name.startswith("r0")
        }
        while not same(first.nodes(), moved):
            assert not first.until("map")["whole"]
        assert not first.links()
        services.events += (MapEvent(10**18 + 1, MapEventKind.PARTED, "they came apart"),)
        assert [event["words"] for event in first.until("events")["history"]] == ["they came apart"]
        # What the server has forgotten is kept for no new viewer, and the next event is new for all.
        services.events = services.events[1:]

        def shown_late() -> list[str]:
            with viewer(served) as late:
                return [event["words"] for event in late.until("events")["history"]]

        eventually(lambda: shown_late() == ["they came apart"])
        services.events = (MapEvent(10**18 + 2, MapEventKind.JOINED, "they are one again"),)
        assert [event["words"] for event in first.until("events")["history"]] == ["they are one again"]
        # What comes in differences is what comes at once.
        with viewer(served) as second:
            second.until("map")
            assert second.nodes() == first.nodes() and second.links() == first.links()
        services.map = merged
        while not same(first.nodes(), expected(merged)):
            first.until("map")


def test_a_component_has_its_floor_as_soon_as_it_is_labelled(served: Web, services: StubServices):
    with viewer(served) as watching:
        assert watching.until("map")["components"][0]["floor"] == ""
        label = Annotation("r1.1", Floor(NodeId("r1", 1, 2), "ground"), False, "anna", 1)
        services.said = Annotations((label,))
        # The merged map is the same; differences with the links' probabilities come, too.
        eventually(lambda: watching.until("map")["components"][0]["floor"] == "ground")


def test_robots_come_twice_a_second(served: Web, services: StubServices):
    status = Status("turning", "", 3, 40, Pose2(), False, covariance=(0.04, 0.01, 0.09, 0.001))
    services.fleet = FleetStatus(
        (RobotEntry("r0", True, 0.2, AgentStatus(status, 5, "r0", 1, battery=0.5), Pose2(1.0, 2.0, 0.3), 0),)
    )
    with viewer(served) as watching:
        (robot,) = watching.until("state")["robots"]
        assert (robot["robot"], robot["merged_from_robot"], robot["component"]) == ("r0", [1.0, 2.0, 0.3], 0)
        assert robot["status"]["battery"] == 0.5
        assert robot["status"]["status"]["covariance"] == [0.04, 0.01, 0.09, 0.001]
        services.fleet = FleetStatus((RobotEntry("r1", False),))
        assert eventually(lambda: watching.until("state")["robots"][0]["robot"] == "r1") is None
        assert watching.last["state"]["server"] == {"summary": "12 nodes"}


def test_a_map_file_is_read_only(services: StubServices, served: Web):
    services.read_only = True
    with viewer(served) as watching:
        hello = watching.until("hello")
        assert (hello["read_only"], hello["commands"]) == (True, False) and "map file" in hello["why_not"]


@pytest.mark.parametrize("headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}])
def test_pages_of_other_sites_do_not_watch(served: Web, headers: dict[str, str]):
    # The library writes Host by itself: a second one is refused as well.
    with pytest.raises(InvalidStatus) as refused, viewer(served, **headers):
        pass
    assert refused.value.response.status_code in (400, 403)


def test_who_takes_nothing_or_says_too_much_is_dropped(services: StubServices):
    with Web(("127.0.0.1", 0), services, limits=ConnectionTimeouts(head=0.5, whole=0.5, stall=0.5)) as served:
        services.holds["summary"] = "x" * 20_000_000
        with socket.socket() as slow:
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            slow.connect(("127.0.0.1", served.port))
            slow.sendall(HANDSHAKE)
            eventually(lambda: served.connections == 1)
            eventually(lambda: served.connections == 0)
        services.holds["summary"] = "short"
        with viewer(served) as watching:
            # The time limits of requests have nothing to do with it.
            for k in range(3):
                services.holds["summary"] = f"look {k}"
                eventually(lambda k=k: watching.until("state")["server"]["summary"] == f"look {k}")
            watching.connection.send("x" * (MAX_VIEWER_BYTES + 1))
            with pytest.raises(ConnectionClosed) as closed:
                for _ in range(3):
                    watching.until("state")
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009, "too long"


def test_viewers_that_are_closed_or_asleep_leave_nothing(services: StubServices):
    """So many each day as may watch at once, and no one could watch any more."""
    limits = ConnectionTimeouts(head=5.0, whole=5.0, stall=0.5)
    with Web(("127.0.0.1", 0), services, limits=limits) as served:
        for _ in range(2 * MOST_VIEWERS):
            with viewer(served) as closed:
                closed.until("hello")
        with ExitStack() as stack:
            for _ in range(MOST_VIEWERS):
                # What a phone leaves whose network is gone: it takes what comes, and answers no ping.
                asleep = stack.enter_context(socket.create_connection(("127.0.0.1", served.port)))
                asleep.sendall(HANDSHAKE)
                assert asleep.recv(4)
            eventually(lambda: served.connections == 0)
            with viewer(served) as watching:
                assert watching.until("state")


def test_an_unchanged_state_is_said_again(services: StubServices, served: Web, monkeypatch):
    """By it a page knows that its server is there."""
    monkeypatch.setattr(live, "SAID_AGAIN", 0.6)
    with viewer(served) as watching:
        first = watching.until("state")
        assert watching.until("state") == first


def test_only_so_many_watch(served: Web):
    with ExitStack() as stack:
        viewers = [stack.enter_context(viewer(served)) for _ in range(MOST_VIEWERS + 1)]
        with pytest.raises(ConnectionClosed) as refused:
            viewers[-1].until("state")
        assert refused.value.rcvd is not None and refused.value.rcvd.code == 1013
        assert viewers[0].until("state")


def test_a_server_that_ends_says_so_to_viewers(services: StubServices):
    with Web(("127.0.0.1", 0), services) as served, viewer(served) as watching:
        watching.until("state")
        served.close()
        with pytest.raises(ConnectionClosed) as closed:
            watching.until("nothing")
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1012


class SlowSocket:
    """A viewer that takes a message when the test lets it."""

    client = None

    def __init__(self) -> None:
        self.taken: list[dict[str, Any]] = []
        self.free = asyncio.Semaphore(0)
        self.gone = asyncio.Event()

    async def accept(self) -> None: ...

    async def receive(self) -> dict[str, Any]:
        await self.gone.wait()
        return {"type": "websocket.disconnect"}

    async def send_text(self, text: str) -> None:
        await self.free.acquire()
        self.taken.append(json.loads(text))


def test_a_slow_viewer_gets_the_newest_state(services: StubServices, monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.http.live.EVERY", 0.005)
    looks = 0

    def status() -> dict[str, Any]:
        nonlocal looks
        looks += 1
        return {"summary": str(looks)}

    async def watch() -> None:
        live, slow = LiveUpdates(services, RequestAuthorization(None, 1.0)), SlowSocket()
        serving = asyncio.create_task(live.serve(slow))  # type: ignore[arg-type]
        for _ in range(3):
            slow.free.release()
        while looks < 40:
            await asyncio.sleep(0.005)
        # The last look may still go on.
        before = looks - 1

        def states() -> list[int]:
            return [int(one["server"]["summary"]) for one in slow.taken if one["kind"] == "state"]

        # The links' probabilities may come in between.
        while not states() or states()[-1] < before:
            taken = len(slow.taken)
            slow.free.release()
            while len(slow.taken) == taken:
                await asyncio.sleep(0.005)
        # One message was on its way already; the next one is of now, and nothing between was kept.
        assert len(states()) <= 3
        slow.gone.set()
        await asyncio.wait_for(serving, 5.0)

    services.status = status  # type: ignore[method-assign]
    asyncio.run(watch())


keys = st.dictionaries(st.integers(0, 12), st.integers(1, 3), max_size=8)


@given(st.lists(keys, min_size=1, max_size=8), st.data())
def test_a_difference_from_any_version_gives_the_rows(steps: list[dict[int, int]], data: st.DataObject):
    table = RowTable([("key", "<u4"), ("value", "<f4")])
    copies: list[np.ndarray] = []
    for version, step in enumerate(steps, 1):
        rows = np.array(
            [(key + 1, value if value < 3 else np.nan) for key, value in step.items()], table.rows.dtype
        )
        table.replace(list(step), rows, version)
        copies.append(table.rows.copy())
        held = {int(row["key"]) - 1: row["value"] for row in table.rows if row["key"]}
        assert held.keys() == step.keys()
    since = data.draw(st.integers(1, len(steps)))
    sent = table.columns(since)
    copy = np.zeros(sent["count"], table.rows.dtype)
    copy[: len(copies[since - 1])] = copies[since - 1]
    picked = np.frombuffer(base64.b64decode(sent["rows"]), "<u4")
    for name, code in (("key", "<u4"), ("value", "<f4")):
        copy[name][picked] = np.frombuffer(base64.b64decode(sent[name]), code)
    assert copy.tobytes() == table.rows.tobytes()
