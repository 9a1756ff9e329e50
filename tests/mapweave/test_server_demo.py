"""`mapweave server --demo` in a process of its own, watched and commanded through a real browser."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from urllib.request import Request, urlopen

import pytest
from websockets.sync.client import connect

from mapweave import Fleet, MissionState, Node, NodeId
from mapweave.hybridmap.change import NodePut
from mapweave.mapserver.http.last_shown import NOTHING
from mapweave.mapserver.http.live import NOT_THERE
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.node_comparisons import compare
from mapweave.mapserver.merging.verification_cache_keeper import VerificationCacheKeeper
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.recorded_fleet.fleet import RecordedFleet, prepare, replayed_robots, split
from mapweave.recorded_fleet.recording import RECORDING, recorded_maps
from mapweave.wire.codec import encode_body
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.core_time import CoreTime
from tests.programs import mapweave, python
from tests.waiting import eventually, free_port

ROBOT = "const r = mapweave.painter.robots.find(one => one.name === '{}'); return r ? [r.x, r.y] : null"
TEXT = "return document.getElementById('{}').textContent"
CLICK = """
const v = mapweave.viewport, m = mapweave.model, [u, w] = v.toScreen({});
const box = mapweave.painter.canvas.getBoundingClientRect();
for (const type of ["pointerdown", "pointerup"])
  mapweave.painter.canvas.dispatchEvent(new PointerEvent(type,
    {{ pointerId: 1, clientX: box.left + u, clientY: box.top + w, bubbles: true }}));
"""
LAYOUT_SHIFT = """
window.shift = 0;
window.shifted = [];
new PerformanceObserver(list => list.getEntries().forEach(one => {
  window.shift += one.value;
  window.shifted.push(...one.sources.map(source => source.node?.parentNode?.id));
}))
  .observe({ type: "layout-shift", buffered: true });
"""


@contextmanager
def demo(http: int, zenoh: int) -> Iterator[subprocess.Popen[bytes]]:
    command = [
        sys.executable, "-m", "mapweave", "server", "--demo", "--http", str(http),
        "--listen", f"tcp/127.0.0.1:{zenoh}",
    ]  # fmt: skip
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=dict(os.environ))
    try:
        yield server
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(30)


def get(http: int, path: str) -> dict:
    try:
        with urlopen(f"http://127.0.0.1:{http}/{path}", timeout=10) as reply:
            return json.load(reply)
    except OSError:
        return {}


def post(http: int, path: str, content: dict) -> dict:
    data, headers = json.dumps(content).encode(), {"Content-Type": "application/json"}
    request = Request(f"http://127.0.0.1:{http}/{path}", data, headers)
    with urlopen(request, timeout=10) as reply:
        return json.load(reply)


def test_the_port_is_open_before_large_libraries_are_loaded():
    """They are a thousand files, which take a second to read where none is in memory."""
    code = (
        "import sys\n"
        "class Stop:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'mapweave.processes.server_name':\n"
        "            sys.exit(' '.join(sorted({'cv2', 'networkx', 'rich', 'scipy', 'zenoh', 'faiss'} "
        "& {*sys.modules})) or 0)\n"
        "sys.meta_path.insert(0, Stop())\n"
        "from mapweave.cli import main\n"
        f"main(['server', '--demo', '--http', '0', '--listen', 'tcp/127.0.0.1:{free_port()}'])\n"
    )
    done = python("-c", code)
    # Port 0 takes a free one, and the line has that.
    assert re.search(r"for people: http://127\.0\.0\.1:[1-9]\d+/\n", done.stdout), "the port is open"
    assert (done.returncode, done.stderr) == (0, ""), "these are loaded already"


@pytest.mark.slow
@pytest.mark.parametrize("soon", [0.0, 0.5, 1.5])
def test_a_demo_that_is_stopped_while_it_starts_leaves_no_folder(tmp_path, soon: float):
    command = [
        sys.executable, "-m", "mapweave", "server", "--demo", "--http", str(free_port()),
        "--listen", f"tcp/127.0.0.1:{free_port()}",
    ]  # fmt: skip
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as server:
        assert server.stdout is not None and "for people" in server.stdout.readline()
        assert [*tmp_path.iterdir()], "it keeps its files there"
        time.sleep(soon)
        server.send_signal(signal.SIGTERM)
        server.communicate(timeout=60)
    assert not [*tmp_path.iterdir()]


def test_a_goal_that_is_not_there_is_refused_with_the_reason(tmp_path):
    """Of a node of its own map that there is not, a robot said that it knows its own map alone."""
    prepare(tmp_path, tmp_path / "s0.sqlite", NOTHING)
    with (
        closing(MemoryBus(MemoryHub())) as bus,
        RecordedFleet(bus, Keys("demo"), "s0", tmp_path),
        Fleet(bus=bus, by="anna") as fleet,
    ):
        refused = [fleet.go("ada", node) for node in ("ada.1.9999", "bo.1.9")]
        taken = fleet.go("ada", "ada.1.9")
    assert [(one.state, one.reason) for one in refused] == [
        (MissionState.REFUSED, "there is no node ada.1.9999; the nearest is ada.1.53"),
        (MissionState.REFUSED, "ada is a recording and knows its own map alone"),
    ]
    assert taken.state is MissionState.RUNNING


def test_a_robot_drives_over_what_it_must_pass_and_shows_its_way(tmp_path):
    """It left out `--via`, and the page showed no way of any robot of the demo."""
    prepare(tmp_path, tmp_path / "s0.sqlite", NOTHING)
    via, goal = NodeId.parse("bo.1.33"), NodeId.parse("bo.1.9")
    with (
        closing(MemoryBus(MemoryHub())) as bus,
        MapServer(bus, Keys("demo"), tmp_path / "s0.sqlite", "s0") as server,
    ):
        assert server.settle(60.0)
        robots = {one.name: one for one in replayed_robots(bus, Keys("demo"), "s0", tmp_path)}
        bo = robots.pop("bo")
        for other in robots.values():
            other.close()
        with closing(bo), Fleet(bus=bus, by="anna") as fleet:
            bo.step(0.2)
            assert fleet.go("bo", str(goal), via=[str(via)]).state is MissionState.RUNNING

            def way() -> tuple[NodeId, ...]:
                bo.step(0.2)
                (entry,) = (one for one in fleet.status().robots if one.robot == "bo")
                return entry.ahead

            eventually(lambda: goal in way() and via in way())
            ahead = way()
            assert ahead[-1] == goal and ahead.index(via) < len(ahead) - 1
            for _ in range(1000):
                bo.step(0.5)
            (report,) = fleet.missions("bo")[-1:]
            assert (report.state, report.passed) == (MissionState.DONE, 1)


def test_the_recording_is_small_and_whole():
    assert RECORDING.stat().st_size < 200_000
    maps = recorded_maps()
    assert {map_id.agent for map_id in maps} == {"ada", "bo", "cy", "dee"}
    for changes in maps.values():
        nodes = [change for change in changes if isinstance(change, NodePut)]
        assert len(nodes) > 10 and len(changes) == 2 * len(nodes) - 1
        assert all(encode_body(change) for change in changes)


def test_what_was_found_of_the_recording_is_kept_and_holds(tmp_path):
    """`python -m synthetic.recorded_fleet` makes it again, for another version or other settings."""
    prepare(tmp_path, tmp_path / "s0.sqlite", NOTHING)
    merged = []
    for kept in (True, False):
        compared: list[tuple[Node, Node]] = []

        def count(pairs: Sequence[tuple[Node, Node]], compared: list = compared) -> Iterator[Verdict]:
            compared += pairs
            return compare(pairs)

        merger = Merger(compare=count)
        if kept:
            VerificationCacheKeeper(tmp_path / "s0.sqlite").restore(merger)
        merger.read(
            (map_id, change)
            for map_id, changes in recorded_maps().items()
            for change in split(map_id, changes)[0]
        )
        merged.append(merger.merged())
        assert bool(compared) is not kept, "nothing is compared again"
    assert [link.pair for link in merged[0].links] == [link.pair for link in merged[1].links]
    for node in merged[1].poses:
        assert merged[0].pose(node).distance(merged[1].pose(node)) < 1e-6


@pytest.mark.slow
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_the_demo_is_watched_and_commanded(tmp_path):
    http, zenoh = free_port(), free_port()
    with Browser(tmp_path / "profile") as page:
        page.look(1280, 800)
        with demo(http, zenoh):
            eventually(lambda: get(http, "status").get("nodes", 0) > 60, seconds=90)
            page.open(f"http://127.0.0.1:{http}/")
            page.run(LAYOUT_SHIFT)
            eventually(lambda: page.run("return window.mapweave?.model.order.length") > 60)
            eventually(lambda: get(http, "status")["components"] == 2, seconds=90)
            eventually(lambda: page.run("return mapweave.model.components.length") == 2)
            eventually(lambda: "are one map now" in page.run(TEXT.format("history")))
            lists = page.run("return document.querySelectorAll('#robots li, #components li').length")
            assert lists == 6, "four robots and two components, also without the canvas"
            before = page.run(ROBOT.format("ada"))
            eventually(lambda: page.run(ROBOT.format("ada")) != before)
            # A node, by a click on the canvas; then a robot is sent there.
            page.run(
                "const m = mapweave.model, row = m.rowOf('ada.1.9');"
                "mapweave.viewport.show(m.x[row], m.y[row], 150)"
            )

            def chosen() -> bool:
                # A robot that stands or drives there is chosen before the node; it goes on.
                page.run(CLICK.format("m.x[m.rowOf('ada.1.9')], m.y[m.rowOf('ada.1.9')]"))
                return "Node ada.1.9" in page.run(TEXT.format("selected"))

            eventually(chosen)
            landmarks = page.run("return document.querySelectorAll('#selected svg circle').length")
            assert landmarks == get(http, "nodes/ada.1.9")["landmarks"]
            page.run(
                "[...document.querySelectorAll('#selected button')]"
                ".find(one => one.textContent === 'Send ada here').click()"
            )
            eventually(lambda: "go to ada.1.9, running" in page.run(TEXT.format("selected")))
            eventually(lambda: "go to ada.1.9, done" in page.run(TEXT.format("selected")), seconds=120)
            page.run(
                "[...document.querySelectorAll('#selected button')]"
                ".find(one => one.textContent === 'Stop').click()"
            )
            eventually(lambda: "stop, done" in page.run(TEXT.format("selected")))
            # A place with a name is found by it.
            place = {"name": "kitchen", "body": {"kind": "place", "node": "ada.1.15"}}
            post(http, "annotations", place)
            eventually(lambda: "kitchen place" in page.run(TEXT.format("places")))
            page.run("document.getElementById('query').value = 'kitchen'")
            page.run("document.getElementById('search').requestSubmit()")
            eventually(lambda: "Node ada.1.15" in page.run(TEXT.format("selected")))
            # A link between two maps shows what both views share.
            page.run(
                "const m = mapweave.model, link = m.links[0];"
                "const [a, b] = [m.edges.a[link], m.edges.b[link]].map(row => m.name(row));"
                "document.getElementById('tab-why').click(); const form = document.getElementById('form');"
                "form.a.value = a; form.b.value = b; form.requestSubmit()"
            )
            eventually(lambda: ": linked: " in page.run(TEXT.format("result")))
            assert page.run("return document.querySelectorAll('#result svg .agree').length") >= 10
            a, b = page.run("return ['a', 'b'].map(name => document.getElementById(name).value)")
            assert page.run("return mapweave.painter.ways") == [{"a": a, "b": b, "dashed": False}]
            # It is undone, and taken back.
            standing = f"explain?a={a}&b={b}"
            page.run(
                "[...document.querySelectorAll('#result button')]"
                ".find(one => one.textContent === 'Undo this link').click()"
            )
            page.type("#edit-because", "two kitchens")
            page.run("document.getElementById('edit-check').click()")
            eventually(lambda: "1 link is undone" in page.run(TEXT.format("edit-answer")))
            page.run("document.getElementById('edit-apply').click()")
            eventually(lambda: "two kitchens" in page.run(TEXT.format("corrections")))
            eventually(lambda: get(http, standing).get("standing") == "undone")
            page.run("document.querySelector('#corrections button').click()")
            eventually(lambda: get(http, standing).get("standing") == "linked")
            assert not any(one["in_force"] for one in get(http, "constraints")["constraints"])
            assert page.run("return window.shift") < 0.02, page.run("return window.shifted")
            assert not page.errors()
        eventually(lambda: "no server" in page.run(TEXT.format("connection")))
        # It was not reached, or gave no answer any more.
        gone = ("ERR_CONNECTION_REFUSED", "ERR_EMPTY_RESPONSE", "WebSocket")
        # The kernel resets a connection that still waits to be accepted when the server's socket closes.
        ending = (*gone, "ERR_CONNECTION_RESET")
        assert not [words for words in page.errors() if not any(one in words for one in ending)]
        with demo(http, zenoh):
            eventually(lambda: page.run(TEXT.format("connection")) == "live", seconds=60)
            eventually(lambda: page.run("return mapweave.model.order.length") > 60)
        assert not [words for words in page.errors() if not any(one in words for one in gone)]


@pytest.mark.slow
def test_robots_events_and_links_are_there_before_the_server_is_loaded():
    http = free_port()
    with demo(http, free_port()):
        messages: dict[str, dict] = {}

        def received() -> bool:
            try:
                with connect(f"ws://127.0.0.1:{http}/live", proxy=None) as socket:
                    while "state" not in messages:
                        message = json.loads(socket.recv(timeout=20))
                        messages[message["kind"]] = message
            except OSError:
                return False
            return True

        eventually(received, 60)
        assert messages["state"]["server"] == {"summary": NOT_THERE, "loading": True}
        robots = messages["state"]["robots"]
        assert [robot["robot"] for robot in robots] == ["ada", "bo", "cy", "dee"]
        assert all(robot["before"] and robot["component"] >= 0 for robot in robots)
        assert len(messages["events"]["history"]) == 2 and len(messages["map"]["components"]) == 2
        # The history of before goes on: nothing comes apart while the maps are read, nothing is said twice.
        eventually(lambda: get(http, "status").get("merged") is True, 90)
        history = get(http, "history")["history"]
        assert history == messages["events"]["history"]


@pytest.mark.slow
def test_the_page_is_filled_within_a_second_of_the_start_of_the_process():
    """A person sees its nodes, robots and events at once, and the server has them once it is loaded."""
    http = free_port()
    with demo(http, free_port()) as server:
        clock, seen = CoreTime(server), set[str]()
        eventually(lambda: get(http, "status") != {}, 90)
        with connect(f"ws://127.0.0.1:{http}/live", proxy=None) as socket:
            while not {"map", "state", "events"} <= seen:
                message = json.loads(socket.recv(timeout=20))
                seen.add(message["kind"])
                match message["kind"]:
                    case "map":
                        assert message["nodes"]["count"] == 87 and message["edges"]["count"] > 87
                    case "state":
                        assert [robot["robot"] for robot in message["robots"]] == ["ada", "bo", "cy", "dee"]
                    case "events":
                        assert message["history"]
        assert clock.look() <= 1.0
        eventually(lambda: not get(http, "status").get("loading"), 90)
        clock = CoreTime(server)
        eventually(lambda: get(http, "status").get("nodes") == 87, 30)
        assert clock.look() <= 1.0


@pytest.mark.slow
def test_the_demo_keeps_nothing(tmp_path):
    begin = time.monotonic()
    done = mapweave("server", "--demo", "--data", tmp_path)
    assert done.returncode != 0
    assert done.stderr.strip() == "mapweave: --demo keeps nothing: leave out --data and --store"
    assert not list(tmp_path.iterdir()) and time.monotonic() < begin + 30.0
