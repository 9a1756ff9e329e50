"""Robots on the page in a real browser: where they drive, their missions, and what is known of them."""

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.web import Web
from synthetic.maps import merger_of
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person, logs
from tests.mapserver.stub_services import StubServices
from tests.mapserver.test_corrections import A
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
GOAL = NodeId("r0", 1, 3)
VIEW = "const v = mapweave.viewport; return [v.x, v.y, v.scale]"
IN_VIEW = (
    "const robot = mapweave.painter.robots.find(one => one.name === 'r0');"
    "return Boolean(robot) && mapweave.viewport.holds(robot.x, robot.y, 20)"
)
SENT = "return document.querySelector('#selected p[role=status]').{}"


class DrivenServices(StubServices):
    """A robot that takes each mission, or does not answer."""

    answers_with = MissionState.RUNNING

    def give(self, robot: str, *_: Any) -> MissionReport:
        return report(self.answers_with)


def report(state: MissionState, progress: float = 0.0, reason: str = "") -> MissionReport:
    order = MissionOrder("m1", "r0", MissionKind.GO, 1, "page", GOAL, goal="hall")
    return MissionReport(order, state, progress, reason)


def robot_at(x: float, y: float, mission: MissionReport | None = None, **more: Any) -> FleetStatus:
    """Its status, and where it is in the frame of component 0, m."""
    doing = Status("driving", "3 nodes further", 3, 40, Pose2(), False, covariance=(0.04, 0.0, 0.01, 0.001))
    status = AgentStatus(doing, 5, "r0", 1, mission=mission, **more)
    return FleetStatus((RobotEntry("r0", True, 0.2, status, Pose2(x, y, 0.3), 0, lag=90.0 if more else 0.0),))


@pytest.fixture
def services() -> DrivenServices:
    return DrivenServices()


@pytest.fixture
def person(browser: Browser, services: DrivenServices) -> Iterator[Person]:
    services.fleet = robot_at(0.0, 0.0)
    with Web(("127.0.0.1", 0), services) as served:
        browser.look(1000, 700)
        browser.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: browser.run("return window.mapweave?.painter.robots.length") == 1)
        yield Person(browser)


def select(person: Person) -> None:
    person.open("selected")
    person.shows("Robot r0")


def test_what_became_of_a_mission_replaces_what_was_said_when_it_was_given(
    person: Person, services: DrivenServices
):
    """Beside "done" the panel went on saying that it was running."""
    select(person)
    person.page.type("#goal", "hall\n")
    eventually(
        lambda: person.page.run(SENT.format("textContent")) == "go to hall (r0.1.3), running (by page)"
    )
    services.fleet = robot_at(0.5, 0.0, report(MissionState.RUNNING, 0.25))
    eventually(lambda: "go to hall (r0.1.3), running 25 % (by page)" in person.text("selected"))
    # A share that grows is not read out.
    assert person.page.run(SENT.format("textContent")) == "go to hall (r0.1.3), running (by page)"
    services.fleet = robot_at(0.5, 0.0, report(MissionState.FAILED, 0.25, "a door is shut"))
    failed = "go to hall (r0.1.3), failed: a door is shut (by page)"
    eventually(lambda: person.page.run(SENT.format("textContent")) == failed)
    assert person.page.run(SENT.format("className")) == "bad"


def test_what_has_not_reached_its_robot_is_not_shown_as_good(person: Person, services: DrivenServices):
    """Also a stop, after which it may be driving, was written in green."""
    services.answers_with = MissionState.SENT
    select(person)
    person.stop()
    eventually(lambda: "sent" in str(person.page.run(SENT.format("textContent"))))
    assert person.page.run(SENT.format("className")) == "warn"


def test_a_robot_at_the_beginning_of_its_map_is_at_zero(person: Person, services: DrivenServices):
    """It was at -0.00 m there."""
    services.fleet = robot_at(-0.006, 0.004)
    select(person)
    eventually(lambda: "on the map-0.01, 0.00 m" in person.text("selected"))
    services.fleet = robot_at(-0.003, -0.004)
    eventually(lambda: "on the map0.00, 0.00 m, 17\u00b0" in person.text("selected"))


GOALS = """
const c = mapweave.painter.canvas, m = mapweave.model, v = mapweave.viewport, ratio = mapweave.painter.ratio;
const red = ([x, y]) => {
  const [u, w] = v.toScreen(x, y).map(one => Math.round(one * ratio));
  const [r, g] = c.getContext('2d').getImageData(u, w, 1, 1).data;
  return r > g + 60;
};
const at = name => { const row = m.rowOf(name); return [m.x[row], m.y[row]]; };
const shares = [...Array(20).keys()].map(k => 0.25 + k / 40);
const share = (a, b) => shares.filter(s => red(a.map((from, k) => from + s * (b[k] - from)))).length / 20;
const robot = mapweave.painter.robots[0], [first, second] = %s.map(at);
return [mapweave.painter.labels.texts.map(one => one.text).filter(text => text.startsWith('goal')),
  share([robot.x, robot.y], first) > 0.8, share(first, second) > 0.8];
"""
"""Texts at goals, and whether the way to the first node and from there to the second is drawn."""


def test_the_goal_of_a_mission_and_the_way_there_are_on_the_map(person: Person, services: DrivenServices):
    """One saw only the words: not where the robot was going."""
    services.map = merger_of(logs()).merged()
    first, second = sorted(node for node in services.map.poses if node.map == A)[-1:-3:-1]
    end = services.map.pose(first)
    drawn = GOALS % [str(first), str(second)]
    running, done = (
        replace(one, order=replace(one.order, node=second))
        for one in (report(MissionState.RUNNING, 0.25), report(MissionState.DONE, 1.0))
    )
    services.fleet = robot_at(end.x, end.y + 1.0)
    eventually(lambda: person.page.run(f"return mapweave.model.rowOf('{first}')") is not None)
    eventually(lambda: abs(person.page.run("return mapweave.painter.robots[0].y") - end.y - 1.0) < 1e-6)
    person.press("fit")
    assert person.page.run(drawn) == [[], False, False]
    (robot,) = robot_at(end.x, end.y + 1.0, running).robots
    services.fleet = FleetStatus((replace(robot, ahead=(first, second)),))
    eventually(lambda: person.page.run(drawn) == [["goal of r0"], True, True])
    # Of a way that is not known the goal alone is shown.
    services.fleet = FleetStatus((robot,))
    eventually(lambda: person.page.run(drawn) == [["goal of r0"], False, False])
    services.fleet = robot_at(end.x, end.y + 1.0, done)
    eventually(lambda: person.page.run(drawn) == [[], False, False])


DRAWN_WAYS = """
return import("/static/goals.js").then(({ drawGoals }) => {
  const goal = { name: "r0", alive: true, way: %s, goal: null, passed: [] };
  return %s.map(scale => {
    const lines = [], viewport = { scale, toScreen: (x, y) => [x * scale, y * scale] };
    const c = { beginPath() {}, stroke() {},
      moveTo(...at) { lines.push([at]); }, lineTo(...at) { lines.at(-1).push(at); } };
    drawGoals(c, viewport, [goal], null);
    return lines;
  });
});
"""
"""The lines that are drawn of a way, px, at some scales, px a metre."""


def test_a_way_is_drawn_over_few_points_and_passes_all(person: Person):
    """The ways of 40 robots took half of a frame: each joint of a wide line takes as long as a short line."""
    # With a corner and 3 cm of noise; beyond a portal, in another part of the map, it goes on.
    here = [[min(k, 40), max(k - 40, 0) + k % 2 * 0.03, 0] for k in range(64)]
    way, scales = [*here, [3, 50, 1], [4, 50, 1]], [10, 14, 16, 200]
    drawn = person.page.run(DRAWN_WAYS % (json.dumps(way), scales))
    for scale, lines in zip(scales, drawn, strict=True):
        first, second = (np.array(line) for line in lines)
        assert second.tolist() == [[3 * scale, 50 * scale], [4 * scale, 50 * scale]]
        for point in scale * np.array(here)[:, :2]:
            along = np.diff(first, axis=0)
            share = ((point - first[:-1]) * along).sum(1) / (along**2).sum(1)
            nearest = first[:-1] + np.clip(share, 0.0, 1.0)[:, None] * along
            assert np.linalg.norm(nearest - point, axis=1).min() <= 1.0
        # Near by, the noise is seen.
        assert len(first) > 40 if scale == 200 else len(first) <= 5


def test_the_selected_robot_stays_in_view(person: Person, services: DrivenServices):
    select(person)
    before = person.page.run(VIEW)
    services.fleet = robot_at(0.2, 0.0)
    eventually(lambda: person.page.run("return mapweave.painter.robots[0].x") == 0.2)
    assert person.page.run(VIEW) == before, "it is in view still"
    for x in (30.0, 60.0):
        services.fleet = robot_at(x, 0.0)
        eventually(lambda x=x: person.page.run("return mapweave.painter.robots[0].x") == x)
        assert person.page.run(IN_VIEW)
    # A person who looks elsewhere is not taken along.
    person.page.run("mapweave.viewport.show(0, 0)")
    before = person.page.run(VIEW)
    services.fleet = robot_at(80.0, 0.0)
    eventually(lambda: person.page.run("return mapweave.painter.robots[0].x") == 80.0)
    assert person.page.run(VIEW) == before


def test_a_robot_that_does_not_know_where_it_is_stays_where_it_was_last(
    person: Person, services: DrivenServices
):
    """As at the beginning of each drive: it vanished from the map."""
    drawn = (
        "const { robots, labels } = mapweave.painter;"
        "return [robots.map(({ x, y, alive, ellipse }) => [x, y, alive, Boolean(ellipse)]),"
        " labels.texts.map(one => one.text).find(text => text.startsWith('r0:'))]"
    )
    services.fleet = robot_at(0.5, 0.25)
    eventually(lambda: person.page.run(drawn) == [[[0.5, 0.25, True, True]], "r0: driving"])
    (robot,) = services.fleet.robots
    services.fleet = FleetStatus((replace(robot, merged_from_robot=None, component=-1),))
    eventually(lambda: person.page.run(drawn) == [[[0.5, 0.25, False, False]], "r0: was here last"])
    assert "not on the map" in person.text("robots")
    services.fleet = robot_at(0.7, 0.25)
    eventually(lambda: person.page.run(drawn) == [[[0.7, 0.25, True, True]], "r0: driving"])


def test_a_click_on_a_robot_moves_no_map(person: Person):
    before = person.page.run(VIEW)
    person.mouse(person.at_robot())
    person.shows("Robot r0")
    assert person.page.run(VIEW) == before


def test_the_whole_map_is_shown_with_the_robots_that_are_near(person: Person, services: DrivenServices):
    """One that mapped at the edge was drawn at the edge of the window, or beyond it."""
    person.page.look(320, 600)
    left, bottom, right, top = person.page.run("return mapweave.model.bounds()")
    wide = max(right - left, top - bottom)
    services.fleet = robot_at(left - 0.24 * max(wide, 4.0), bottom)
    eventually(lambda: person.page.run("return mapweave.painter.robots[0].x") < left)
    eventually(lambda: person.page.run(IN_VIEW))
    person.press("fit")
    assert person.page.run(IN_VIEW)
    # One that believes to be far away makes nothing small.
    services.fleet = robot_at(right + 100.0, bottom)
    eventually(lambda: person.page.run("return mapweave.painter.robots[0].x") > 90.0)
    person.press("fit")
    scale = person.page.run("return mapweave.viewport.scale")
    services.fleet = robot_at(0.5 * (left + right), bottom)
    eventually(lambda: person.page.run("return mapweave.painter.robots[0].x") < 90.0)
    person.press("fit")
    assert person.page.run("return mapweave.viewport.scale") == scale


def test_the_facts_of_a_robot_can_be_marked_while_statuses_come(person: Person, services: DrivenServices):
    """They were made again twice a second, and what was marked was lost."""
    select(person)
    person.page.run(
        "const facts = [...document.querySelectorAll('#selected dt')];"
        "const fact = facts.find(one => one.textContent === 'doing');"
        "getSelection().selectAllChildren(fact.nextSibling)"
    )
    services.fleet = robot_at(0.7, 0.0)
    eventually(lambda: "0.70, 0.00 m" in person.text("selected"))
    assert person.page.run("return getSelection().toString()") == "driving: 3 nodes further"


def test_battery_queue_lag_and_trouble_are_shown(person: Person, services: DrivenServices):
    select(person)
    services.fleet = robot_at(
        0.0, 0.0, battery=0.62, unsent=17, last_error="the disk is full", error_age=200.0
    )
    eventually(lambda: "the disk is full (for 3 min)" in person.text("selected"))
    facts = person.facts()
    assert facts["battery"] == "62 %" and facts["not yet on the server"] == "17 changes, one for 2 min"
    assert facts["state"] == "alive" and facts["last heard"] == "0.2 s ago"
    services.fleet = robot_at(0.0, 0.0)
    eventually(lambda: "the disk is full" not in person.text("selected"))
    assert "battery" not in person.text("selected")


def test_words_that_say_what_to_type_are_not_cut_off(person: Person):
    select(person)
    cut = person.page.run("""
        const c = document.createElement('canvas').getContext('2d');
        return [...document.querySelectorAll('#selected input')].filter(one => {
          const style = getComputedStyle(one);
          c.font = style.font;
          return c.measureText(one.placeholder).width > one.clientWidth - 2 * parseFloat(style.paddingLeft);
        }).map(one => one.placeholder)
    """)
    assert cut == []


def test_another_mouse_button_neither_selects_nor_moves(person: Person, services: DrivenServices):
    """A right click selected; with the menu that it opens its end is not heard of, and the map hung on."""
    page, before = person.page, person.page.run(VIEW)
    x, y = person.at_robot()

    def mouse(kind: str, button: str, buttons: int, x: float) -> None:
        page.devtools(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=1
        )

    mouse("mousePressed", "right", 2, x)
    mouse("mouseReleased", "right", 0, x)
    mouse("mousePressed", "middle", 4, x)
    for step in range(5):
        mouse("mouseMoved", "none", 0, x + 20.0 * step)
    mouse("mouseReleased", "middle", 0, x)
    assert page.run(VIEW) == before and "Select a node" in person.text("selected")
    # Nor does a drag go on whose end was not heard of.
    mouse("mousePressed", "left", 1, x)
    mouse("mouseMoved", "left", 1, x + 40.0)
    after = page.run(VIEW)
    assert after != before
    mouse("mouseMoved", "none", 0, x + 80.0)
    assert page.run(VIEW) == after
