"""The page in a real browser with robots that drive: server, simulator and two agents as processes."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from websockets.sync.client import connect

from mapweave.evaluation.map_score import pose_error
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.children import Children
from mapweave.sim.ground_truth_client import SimControl
from mapweave.storage.map_file import unpack_map_file
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode
from mapweave.wire.zenoh_bus import ZenohBus
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person
from tests.simulator import needs_simulator
from tests.waiting import eventually, free_port

PATIENCE = 120.0
"""s, on a machine that does other things."""
FLEET = "watched"
ROBOTS = ("r0", "r1")
GRACE = 10.0
"""s for which robots that were sent drive on without an operator."""
SEEN = """
window.seen = {}; window.ways = {};
setInterval(() => {
  for (const { robot, ahead } of mapweave.page.robots) if (ahead.length) window.ways[robot] = ahead.at(-1);
  for (const { name, x, y, heading, ellipse, doing } of mapweave.painter.robots) {
    const one = window.seen[name] ||= { poses: [], doing: [], sigmas: [] }, pose = [x, y, heading].join();
    if (one.poses.at(-1) !== pose) one.poses.push(pose);
    if (one.doing.at(-1) !== doing) one.doing.push(doing);
    if (ellipse) one.sigmas.push(ellipse.major);
  }
}, 100)
"""
LISTED = """
const words = document.getElementById('robots').textContent, { robots } = mapweave.painter;
// On a busy machine nothing may be heard of one for a while.
const state = name => mapweave.page.robots.find(({ robot }) => robot === name).age > 5 ? 'silent' : 'alive';
return robots.every(({ name, alive, doing }) => !alive || words.includes(`${name} ${state(name)} ${doing}`));
"""
WHERE = """
const robot = mapweave.painter.robots.find(one => one.name === 'r0'), m = mapweave.model, row = m.rowOf('{}');
return [[m.x[row], m.y[row], m.nodes.heading[row]], [robot.x, robot.y, robot.heading]]
"""


class Fleet:
    """The processes, and what the simulator knows.

    Attributes:
        children: the processes.
        http: port of the page.
    """

    def __init__(self, folder: Path, children: Children, bus: ZenohBus, endpoint: str, world: str) -> None:
        settings = folder / "server.toml"
        settings.write_text(f'[attendance]\nunattended = "stand"\ngrace = {GRACE}\n')
        self.children, self.http, self._bus = children, free_port(), bus
        self._server = ["server", "--fleet", FLEET, "--listen", endpoint, "--data", str(folder / "server")]
        self._server += ["--http", str(self.http), "--settings", str(settings)]
        self.start_server()
        eventually(bus.connected, PATIENCE)
        network = ["--fleet", FLEET, "--connect", endpoint]
        children.start("sim", ["sim", "serve", world, "--seed", "3", "--set", "robots=2", *network])
        for name in ROBOTS:
            agent = ["agent", name, "--data", str(folder), "--epoch", "1", "--lockstep", *network]
            children.start(name, agent)
        self._control = SimControl(bus, FLEET)

    def start_server(self) -> None:
        self.children.start("server", self._server)

    def truth(self, goal: NodeId) -> tuple[Pose2, Pose2]:
        """Where a node of r0 was made, and where r0 is."""
        packed = self._bus.ask(Keys(FLEET).server_map("s0"), b"", 20)[0].payload
        changes = unpack_map_file(packed).changes
        (node,) = (one.node for one in changes if getattr(getattr(one, "node", None), "id", None) == goal)
        (made,) = self._control.truth_at("r0", [node.stamp_ns])
        return made, self.stands("r0")

    def mission(self, robot: str) -> MissionReport:
        """What a robot itself says."""
        (reply,) = self._bus.ask(Keys(FLEET).agent_status(robot), b"", 20)
        report = decode(reply.payload, AgentStatus).mission
        assert report is not None
        return report

    def moved(self, robot: str, seconds: float) -> float:
        """How far a robot gets in a time of the simulation, which may be slower than the clock, m."""
        before = self._control.status()
        end = before.stamp_ns + round(1e9 * seconds)
        eventually(lambda: self._control.status().stamp_ns >= end, PATIENCE)
        return pose_error(self.stands(robot), before.robots[robot].world_from_robot)[0]

    def stands(self, robot: str) -> Pose2:
        """Where a robot is."""
        return self._control.status().robots[robot].world_from_robot


@pytest.fixture
def fleet(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Fleet]:
    world = getattr(request, "param", "passing")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    bus = ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))
    try:
        with Children(tmp_path / "logs") as children:
            yield Fleet(tmp_path, children, bus, endpoint, world)
    finally:
        bus.close()


@pytest.mark.slow
@needs_simulator
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
@pytest.mark.timeout(600)
def test_robots_that_drive_are_watched_and_sent(fleet: Fleet, browser: Browser):
    """They map, and move on the page; one is sent to a node, and parks there; the server starts again."""
    person = Person(browser)
    person, goal = Person(browser), NodeId("r0", 1, 1)
    eventually(lambda: fleet.children.check() or serves(browser, fleet.http), PATIENCE)
    browser.look(1280, 800)
    browser.errors()
    browser.run(SEEN)
    drawn = "return mapweave.model.order.length >= 8 && mapweave.painter.robots.length === 2"
    eventually(lambda: fleet.children.check() or browser.run(drawn), PATIENCE)
    moving = "return Object.values(window.seen).every(one => one.poses.length > 10 && one.doing.length > 2)"
    eventually(lambda: browser.run(moving), PATIENCE)
    seen = browser.run("return window.seen")
    for name in ROBOTS:
        poses = np.array([[float(number) for number in pose.split(",")] for pose in seen[name]["poses"]])
        assert np.ptp(poses[:, :2], axis=0).max() > 0.05 and np.ptp(poses[:, 2]) > 0.2, name
        assert 0.0 < max(seen[name]["sigmas"]) < 2.0
    assert browser.run(LISTED)
    # A robot that is far ahead of its map comes into view with its next node.
    in_view = "return mapweave.painter.robots.every(({ x, y }) => mapweave.viewport.holds(x, y, 10))"
    eventually(lambda: browser.run(in_view), PATIENCE)

    browser.run("document.querySelector('#robots button').click()")
    eventually(lambda: person.facts()["state"] == "alive")
    assert person.facts()["sees the server"] == "yes" and "explore" in person.facts()["mission"]
    browser.type("#goal", f"{goal}\n")
    eventually(lambda: person.facts()["mission"].startswith(f"go to {goal}, running"))
    eventually(lambda: person.facts()["mission"].startswith(f"go to {goal}, done: at the goal"), PATIENCE)
    assert browser.run("return window.ways.r0") == str(goal), "its way there was known while it drove"
    eventually(
        lambda: (
            f"go to {goal}, done" in browser.run("return document.querySelector('#selected p').textContent")
        )
    )
    shown = [Pose2(*pose) for pose in browser.run(WHERE.format(goal))]
    made, stands = fleet.truth(goal)
    distance, angle = pose_error(shown[0].inverse() @ shown[1], made.inverse() @ stands)
    assert distance < 0.03 and np.degrees(angle) < 2.0
    assert pose_error(stands, made)[0] < 0.05
    person.press("tab-events")
    eventually(lambda: f"commanded: r0: go to {goal}, by page" in person.text("events"))

    nodes = browser.run("return mapweave.model.order.length")
    fleet.children.end("server")
    eventually(lambda: person.text("connection") == "no server, trying again")
    assert "alive" not in person.text("robots")
    fleet.start_server()
    eventually(lambda: person.text("connection") == "live", PATIENCE)
    eventually(
        lambda: [name for name in ROBOTS if f"{name} alive" in person.text("robots")] == list(ROBOTS),
        PATIENCE,
    )
    assert browser.run("return mapweave.model.order.length") >= nodes
    # What failed while there was no server is no error of the page.
    assert not [line for line in browser.errors() if "ERR_CONNECTION" not in line and "WebSocket" not in line]


@pytest.mark.slow
@pytest.mark.waits
@needs_simulator
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
@pytest.mark.timeout(600)
@pytest.mark.parametrize("fleet", ["office"], indirect=True)
def test_robots_that_were_sent_stand_once_the_last_page_is_closed(fleet: Fleet, browser: Browser):
    """Of two pages the first may close, and the last one be loaded again; what no person has sent goes on.

    An office is not explored before the end.
    """
    person = Person(browser)
    eventually(lambda: fleet.children.check() or serves(browser, fleet.http), PATIENCE)
    both = "return mapweave.page.robots.filter(one => one.alive).length === 2"
    eventually(lambda: fleet.children.check() or browser.run(both), PATIENCE)
    words = "Robots that were sent stand 10 s after the last operator's page was closed."
    eventually(lambda: person.text("unattended") == words)
    given = browser.run(
        "return fetch('robots/r0/explore?by=anna', { method: 'POST' }).then(one => one.json())"
    )
    assert given["state"] == "running"
    # A page that is loaded again and again, for longer than the grace.
    end = time.monotonic() + 1.5 * GRACE
    while time.monotonic() < end:
        serves(browser, fleet.http)
        assert fleet.mission("r0").order.by == "anna"
    with connect(f"ws://127.0.0.1:{fleet.http}/live") as other:
        browser.open("about:blank")
        end = time.monotonic() + 1.2 * GRACE
        while time.monotonic() < end:
            other.recv(timeout=20)
        assert fleet.mission("r0").order.by == "anna", "another operator looks on"
    closed = time.monotonic()
    eventually(lambda: fleet.mission("r0").order.kind is MissionKind.STOP, PATIENCE)
    assert time.monotonic() - closed > GRACE - 1.0
    eventually(lambda: fleet.mission("r0").state is MissionState.DONE)
    assert fleet.mission("r0").order.by == "s0"
    assert fleet.mission("r1").order.by == "start" and fleet.mission("r1").state is MissionState.RUNNING
    # The order is done before the wheels have come to rest; then it does not move at all.
    fleet.moved("r0", 2.0)
    assert fleet.moved("r0", 0.5) < 0.0001
    assert fleet.moved("r0", 5.0) < 0.001
    eventually(lambda: serves(browser, fleet.http))
    person.press("tab-events")
    eventually(lambda: "no operator was there for 10 s" in person.text("events"))


def serves(browser: Browser, port: int) -> bool:
    """Opens the page, if it is there."""
    browser.open(f"http://127.0.0.1:{port}/")
    return bool(browser.run("return Boolean(window.mapweave)"))
