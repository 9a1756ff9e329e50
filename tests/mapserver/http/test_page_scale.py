"""20 000 nodes on the page in a real browser: bytes, time to the first picture, frames."""

import socket
import subprocess
import sys
import time

import pytest

from mapweave.hybridmap.agent_status import MOST_AHEAD, AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.web import Web
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.map_file import MapFile, write_map_file
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.large_map import large_map
from tests.mapserver.stub_services import StubServices
from tests.waiting import eventually, free_port

# What a person does, and what is measured: `act` is done every `every` ms, `count` times, then the map rests.
GESTURE = """
const {{ every, count, act }} = {gesture};
window.frames = [];
const began = performance.now();
let last = began, done = 0;
function step(now) {{
  window.frames.push(now - last);
  last = now;
  if (now - began >= done * every && done < count) act(done++);
  if (now - began < count * every + 500) requestAnimationFrame(step); else window.frames.done = true;
}}
window.frames.done = false;
requestAnimationFrame(step);
"""
WHEEL = """{{ every: {every}, count: {count}, act: k => mapweave.painter.canvas.dispatchEvent(
  new WheelEvent("wheel", {{ deltaY: {delta}, clientX: 500, clientY: 400,
  cancelable: true, bubbles: true }})) }}"""
GESTURES = {
    "pan": "{ every: 16, count: 120, act: k => { mapweave.viewport.pan(7, k % 50 < 25 ? 4 : -4);"
    " mapweave.painter.ask(); } }",
    "trackpad in": WHEEL.format(every=16, count=120, delta=-15),
    "trackpad out": WHEEL.format(every=16, count=120, delta=15),
    "wheel in": WHEEL.format(every=200, count=12, delta=-100),
    "wheel out": WHEEL.format(every=200, count=12, delta=100),
}
# ms. A frame of a display is 17 ms; this leaves out one frame in between.
SMOOTH = 34.0
DRAWN = "return performance.getEntriesByName('map drawn')[0]?.startTime"
NODES = "return window.mapweave ? mapweave.model.order.length : 0"
SHARP = "return mapweave.painter.drawn.scale === mapweave.viewport.scale && !mapweave.painter.waiting"
STRAY = "const b = mapweave.model.bounds(); return Math.max(b[2] - b[0], b[3] - b[1])"


def serves(port: int) -> bool:
    """Whether a program takes connections at a port of loopback."""
    try:
        with socket.create_connection(("127.0.0.1", port), 1.0):
            return True
    except OSError:
        return False


class DrivenServices(StubServices):
    """40 robots drive along their nodes, a node each two statuses."""

    def __init__(self, merged: MergedMap) -> None:
        super().__init__()
        self.map, self._began = merged, time.monotonic()

    def robots(self) -> FleetStatus:
        driven = (time.monotonic() - self._began) % 400.0
        return FleetStatus(tuple(self._robot(k, driven) for k in range(40)))

    def _robot(self, k: int, driven: float) -> RobotEntry:
        assert self.map is not None
        a, b = (self.map.graphs[0].pose(NodeId(f"r{k}", 1, int(driven) + step)) for step in (0, 1))
        share = driven % 1.0
        at = Pose2(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), a.heading)
        status = Status("travelling", "", 3, 40, Pose2(), False, covariance=(0.01, 0.0, 0.02, 0.001))
        # Each has a long way before it.
        ahead = tuple(NodeId(f"r{k}", 1, (int(driven) + step) % 500) for step in range(1, MOST_AHEAD + 1))
        order = MissionOrder("m1", f"r{k}", MissionKind.GO, 1, "anna", ahead[-1])
        said = AgentStatus(
            status, int(1e9 * driven), f"r{k}", 1, mission=MissionReport(order, MissionState.RUNNING)
        )
        return RobotEntry(f"r{k}", True, 0.1, said, at, 0, ahead=ahead)


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_20_000_nodes_are_smooth(tmp_path):
    services = DrivenServices(large_map(robots=40, nodes=500, links=3000))
    with Web(("127.0.0.1", 0), services) as served, Browser(tmp_path) as page:
        page.look(1280, 800)
        page.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: page.run(NODES) == 20_000)
        eventually(lambda: page.run(DRAWN) is not None)
        sent, drawn = page.run("return mapweave.page.bytes"), page.run(DRAWN)
        # This allows for a machine that does other things.
        assert sent < 1.5e6, "of text, before it is compressed"
        assert drawn < 5000.0
        assert page.run(STRAY) < 200.0
        eventually(lambda: page.run("return mapweave.painter.robots.length") == 40)
        moved = "return mapweave.painter.robots.map(one => one.x)"
        before = page.run(moved)
        slow = {}
        for name, gesture in GESTURES.items():
            page.run(GESTURE.format(gesture=gesture))
            eventually(lambda: page.run("return window.frames.done"))
            frames = sorted(page.run("return [...window.frames]")[1:])
            late = frames[int(0.95 * len(frames))]
            middle, worst = frames[len(frames) // 2], frames[-1]
            print(f"{name}: {middle:.1f} ms a frame, p95 {late:.1f}, worst {worst:.1f}")
            if late > SMOOTH:
                slow[name] = late
            # At rest it is sharp.
            eventually(lambda: page.run(SHARP))
        assert not slow
        assert all(a != b for a, b in zip(before, page.run(moved), strict=True)), "all robots have moved"
        print(f"{sent} bytes, drawn after {drawn:.0f} ms")


@pytest.mark.slow
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_a_map_file_of_20_000_nodes_is_opened_and_shown(tmp_path):
    """By `mapweave open` as a process."""
    merged = large_map(robots=40, nodes=500, links=3000)
    edges = {edge.id: edge for edge in (link.edge() for link in merged.links)}
    changes = [change for one in merged.maps.values() for change in one.contents()]
    changes += [EdgePut(edge) for edge in edges.values()]
    path, port = tmp_path / "large.mapweave", free_port()
    write_map_file(path, MapFile("merged", merged.summary(), tuple(changes)))
    command = [sys.executable, "-m", "mapweave", "open", str(path), "--http", str(port)]
    opened = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        with Browser(tmp_path / "profile") as page:
            page.look(1280, 800)
            eventually(lambda: serves(port), 120.0)
            page.open(f"http://127.0.0.1:{port}/")
            eventually(lambda: page.run(NODES) == 20_000)
            eventually(lambda: page.run(DRAWN) is not None)
            assert page.run("return mapweave.page.bytes") < 1.5e6 and page.run(DRAWN) < 5000.0
            assert page.run("return mapweave.model.components.length") == 1
    finally:
        opened.terminate()
        opened.wait(30)
