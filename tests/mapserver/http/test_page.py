"""Photos on the page in a real browser: one is chosen, sent, and the answer shown, or why there is none."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.annotation import Annotation, Annotations, Floor, Place
from mapweave.hybridmap.errors import Busy, InvalidValue
from mapweave.hybridmap.floor_plan import PlacedPlans
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, SimilarPlace, View
from mapweave.mapserver.http.web import Web
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person
from tests.mapserver.http.test_live import less
from tests.mapserver.stub_services import PLACE, StubServices, picture, two_maps
from tests.mapweave.test_plan_answers import PLAN
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
RESULT = "return document.getElementById('answer').textContent"
ROWS = "return [...document.querySelectorAll('tr')].map(r => [...r.children].map(c => c.textContent))"
CONTROLS = {
    "application", "button", "checkbox", "combobox", "image", "link", "searchbox", "slider", "spinbutton",
    "tab", "tablist", "tabpanel", "textbox",
}  # fmt: skip
STATUS = "return document.getElementById('summary').textContent"
PLANS = "return import('/static/plans.js').then(one => one.planNames().length)"
KIND = "const answer = document.getElementById('answer'); return answer.dataset.certainty || answer.className"


def text_of(name: str) -> str:
    return f"return document.getElementById('{name}').textContent"


def at_widths(page: Browser, widths: Sequence[int], script: str, phones: bool = False) -> dict[int, Any]:
    """What a script returns in windows so many px wide; narrow ones may be those of phones."""
    try:
        found = {}
        for width in widths:
            page.look(width, 844, mobile=phones and width < 760)
            found[width] = page.run(script)
        return found
    finally:
        page.look(420, 800)


@pytest.fixture
def page(browser: Browser, services: StubServices) -> Iterator[Browser]:
    with Web(("127.0.0.1", 0), services) as served:
        browser.open(f"http://127.0.0.1:{served.port}/")
        yield browser


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "photo.jpg"
    path.write_bytes(picture(kind=".jpg"))
    return path


def test_a_picture_is_answered_on_the_page(page: Browser, services: StubServices, image: Path):
    eventually(lambda: page.run(STATUS) == "12 nodes")
    page.run("document.getElementById('tab-photo').click()")
    page.type("#hfov", "90")
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "found")
    assert page.run(RESULT).startswith("found: 31 landmarks of r0.1.7 agree")
    rows = page.run(ROWS)
    assert rows == [
        ["place", "ahead", "left", "turned", "probability"],
        ["r0.1.7", "0.50 m", "-0.25 m", "6°", "99 %"],
    ]
    eventually(lambda: page.run("return document.getElementById('shown').naturalWidth") == 160)
    assert services.views[-1].camera.fx == pytest.approx(80.0)


def test_an_unknown_place_is_explained(page: Browser, services: StubServices, image: Path):
    near = SimilarPlace(NodeId("r0", 1, 3), 14, 9, 10, "only 31% of the matches agree on one pose", 0.6)
    services.answer = RelocalizeAnswer(Certainty.UNKNOWN, (), "not recognised", (near,))
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "unknown")
    words = page.run(RESULT)
    assert "unknown: not recognised" in words and "r0.1.3 only 31% of the matches agree on one pose." in words
    assert "14 landmarks match, 9 agree on one pose; 10 are needed." in words
    assert "Turn by 34° to the left and try again." in words
    page.run("document.querySelector('#answer li button').click()")
    Person(page).shows("Node r0.1.3")


@pytest.mark.parametrize(("matches", "inliers", "doubted"), [(77, 0, True), (14, 9, False), (31, 10, False)])
def test_a_camera_that_was_given_wrongly_is_suspected(
    page: Browser, services: StubServices, image: Path, matches: int, inliers: int, doubted: bool
):
    """A photo with the default height of the lens and angle of view was only said to agree on no pose."""
    near = SimilarPlace(NodeId("r0", 1, 3), matches, inliers, 10, "matches agree on no pose", None)
    services.answer = RelocalizeAnswer(Certainty.UNKNOWN, (), "not recognised", (near,))
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "unknown")
    assert ("check the height of the lens and the angle of view" in page.run(RESULT)) == doubted


def test_the_answer_to_the_photo_before_does_not_replace_that_to_the_last_one(
    page: Browser, services: StubServices, image: Path, monkeypatch
):
    """A photo of which the answer took longer was answered below the picture of the next one."""
    asked: list[Future[RelocalizeAnswer]] = []

    def locate(look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        look()
        asked.append(Future())
        return asked[-1]

    monkeypatch.setattr(services, "locate", locate)
    for count in (1, 2):
        page.type("#image", str(image.rename(image.with_name(f"{count}.jpg"))))
        image = image.with_name(f"{count}.jpg")
        eventually(lambda count=count: len(asked) == count)
    asked[1].set_result(PLACE)
    eventually(lambda: page.run(KIND) == "place")
    asked[0].set_result(services.answer)
    answered = (
        "return performance.getEntriesByType('resource').filter(one => one.name.includes('/relocalize'))"
    )
    eventually(lambda: len(page.run(answered)) == 2)
    page.run("return fetch('status').then(() => true)")
    assert page.run(KIND) == "place" and len(page.run(ROWS)) == 2


def test_no_unknown_distance_is_shown(page: Browser, services: StubServices, image: Path):
    services.answer = PLACE
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "place")
    assert page.run(ROWS)[1] == ["r0.1.7", "not known", "not known", "6°", "90 %"]


def test_an_answer_names_the_place_and_the_floor(page: Browser, services: StubServices, image: Path):
    (where,) = PLACE.candidates
    services.answer = replace(PLACE, candidates=(replace(where, place="<b>kitchen", floor="ground"),))
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "place")
    assert page.run(ROWS)[1][0] == "r0.1.7<b>kitchen, floor ground"


def test_robots_and_photos_are_named_in_coordinates_of_a_plan(
    page: Browser, services: StubServices, image: Path, monkeypatch
):
    """Of plan office under component 1, and of none under component 0."""
    monkeypatch.setattr(services, "plans", lambda: PlacedPlans((PLAN,)), raising=False)
    at = Pose2(2.0, 1.0, 0.0)
    services.fleet = FleetStatus(
        tuple(RobotEntry(f"r{k}", True, merged_from_robot=at, component=k) for k in range(2))
    )
    found = replace(PLACE.candidates[0], merged_from_robot=PoseGaussian.from_sigmas(at, 0.1, 0.1))
    services.answer = replace(PLACE, candidates=(replace(found, component=1), replace(found, component=0)))
    page.run("document.dispatchEvent(new Event('mapchanged'))")
    eventually(lambda: page.run("return document.querySelectorAll('#robots button').length") == 2)
    eventually(lambda: page.run(PLANS) == 1)
    for number, words in ((1, "office 9.00, 7.00 m, 90°"), (0, None)):
        page.run(f"document.querySelectorAll('#robots button')[{number}].click()")
        facts = Person(page).facts()
        assert facts["on the map"].startswith("2.00, 1.00 m") and facts.get("on the plan") == words
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "place")
    assert [row[0] for row in page.run(ROWS)[1:]] == ["r0.1.7on plan office 9.00, 7.00 m, 90°", "r0.1.7"]


def test_nodes_are_named_and_found_in_coordinates_of_a_plan(
    page: Browser, services: StubServices, monkeypatch
):
    """As robots and photos are: what the panel shows can be typed, in the search and for missions."""
    placed = replace(PLAN, name="ground floor", parts=(replace(PLAN.parts[0], component=0),))
    monkeypatch.setattr(services, "plans", lambda: PlacedPlans((placed,)), raising=False)
    services.fleet = FleetStatus((RobotEntry("r0", True),))
    page.run("document.dispatchEvent(new Event('mapchanged'))")
    node = NodeId("r0", 1, 5)
    (at,) = (pose.mean for id_, (_, pose) in two_maps().poses.items() if id_ == node)
    words = f"ground floor {10.0 - at.y:.2f}, {5.0 + at.x:.2f}"
    person = Person(page)
    eventually(lambda: page.run(PLANS) == 1)
    for typed in (words, words.replace(", ", ",")):
        person.search("r0.1.1")
        person.shows("Node r0.1.1")
        person.search(typed)
        person.shows(f"Node {node}")
    assert person.facts()["on the plan"].startswith(f"{words} m, ")
    person.search("ground floor 500,500")
    says = page.run("return document.getElementById('query').validationMessage")
    assert says == "Nothing is mapped within 2 m of ground floor 500,500."
    eventually(lambda: page.run("return document.querySelector('#robots button') !== null"))
    page.run("document.querySelector('#robots button').click(); document.getElementById('goal').value = ''")
    page.type("#via", f"r0.1.1, {words}, r0.1.7")
    page.type("#goal", f"{words}\n")
    eventually(lambda: services.ways == [(str(node), ("r0.1.1", str(node), "r0.1.7"))])
    page.run("document.getElementById('goal').value = 'ground floor 500,500'")
    page.type("#goal", "\n")
    eventually(lambda: "Nothing is mapped within 2 m of ground floor" in page.run(text_of("selected")))
    assert len(services.ways) == 1


def test_what_is_no_image_is_not_sent(page: Browser, services: StubServices, tmp_path):
    (tmp_path / "notes.log").write_text("no image")
    page.type("#image", str(tmp_path / "notes.log"))
    eventually(lambda: page.run(KIND) == "box failed")
    assert page.run(RESULT) == "notes.log is no image that can be read: choose a JPEG or PNG."
    assert not page.run("return document.getElementById('shown').checkVisibility()") and not services.views


def test_a_robot_passes_places_on_its_way(page: Browser, services: StubServices):
    node = NodeId("r0", 1, 1)
    services.said = Annotations(
        tuple(Annotation(name, Place(node), False, "anna", 1) for name in ("east", "east wing"))
    )
    services.fleet = FleetStatus((RobotEntry("r0", True, place="east wing", floor="ground"),))
    eventually(lambda: "at east wing, floor ground" in page.run(text_of("robots")))
    eventually(lambda: "east wing" in page.run(text_of("names").replace("textContent", "innerHTML")))
    page.run("document.querySelector('#robots button').click()")
    facts = Person(page).facts()
    assert (facts["place"], facts["floor"]) == ("east wing", "ground")
    page.type("#goal", "home")
    # A position also with a blank, as on a plan and in the shell.
    page.type("#via", "east wing, 3.1, -2.0 r0.1.1, east\n")
    eventually(lambda: services.ways == [("home", ("east wing", "3.1,-2.0", "r0.1.1", "east"))])
    eventually(lambda: "r0 stays where it is" in page.run(text_of("selected")))
    page.type("#mission-because", "a guest & a dog wait")
    Person(page).stop()
    eventually(lambda: services.reasons == ["", "a guest & a dog wait"])


def test_errors_are_shown_on_the_page(page: Browser, services: StubServices, image: Path):
    services.refusal = InvalidValue("<b>this</b> is no place")
    page.type("#image", str(image))
    eventually(lambda: page.run(KIND) == "box failed")
    # As text, with any content.
    assert "<b>this</b> is no place" in page.run(RESULT)
    assert page.run("return document.querySelector('#answer b')") is None


@pytest.mark.slow
def test_a_busy_server_is_asked_again(page: Browser, services: StubServices, image: Path):
    services.refusal = Busy(0.2)
    page.type("#image", str(image))
    eventually(lambda: "waiting" in page.run(RESULT))
    services.refusal = None
    eventually(lambda: page.run(KIND) == "found")


@pytest.mark.parametrize(("robots", "gap"), [(2, 0.0), (4, 40.0)])
def test_labels_do_not_lie_on_each_other(page: Browser, services: StubServices, robots: int, gap: float):
    """Robots so many px apart, amid places at one node."""
    node = NodeId("r0", 1, 1)
    places = [Annotation(f"place {k}", Place(node), False, "anna", 1) for k in range(6)]
    label = Annotation("r0.1", Floor(node, "ground"), False, "anna", 1)
    services.said = Annotations((*places, label))
    page.run("document.dispatchEvent(new Event('mapchanged'))")
    eventually(lambda: page.run("return document.querySelectorAll('#places li').length") == 7)
    eventually(lambda: page.run("return mapweave.model.rowOf('r0.1.1')") is not None)
    texts, overlaps = page.run(f"""
        const p = mapweave.painter, row = p.model.rowOf("r0.1.1"), x = p.model.x[row], y = p.model.y[row];
        p.viewport.show(x, y);
        p.robots = [...Array({robots}).keys()].map(k => ({{ name: `r${{k}}`, doing: "driving", alive: true,
          x: x + {gap} * k / p.viewport.scale, y, heading: 0 }}));
        p.frame();
        const labels = p.labels.texts;
        return [labels.map(one => one.text), labels.map((a, k) => labels.slice(k + 1)
          .filter(b => Math.abs(a.base - b.base) < 12 && a.left < b.left + b.wide && b.left < a.left + a.wide)
          .length)]
    """)
    assert overlaps == [0] * len(texts)
    assert {"floor ground", *(one.name for one in places)} <= set(texts)
    assert all({f"r{k}", f"r{k}: driving"} & set(texts) for k in range(robots))


def test_the_selected_node_has_its_name_at_every_scale(page: Browser):
    """Its neighbour's name lay in its ring, and its own was left out; from afar no node has a name."""
    eventually(lambda: page.run("return mapweave.model.rowOf('r0.1.3')") is not None)
    Person(page).search("r0.1.3")
    for scale in (20.0, 60.0, 200.0):
        texts, within = page.run(f"""
            const p = mapweave.painter, v = p.viewport, m = p.model, row = m.rowOf("r0.1.3");
            v.show(m.x[row], m.y[row]); v.scale = {scale}; p.frame();
            const [x, y] = v.toScreen(m.x[row], m.y[row]), texts = p.labels.texts;
            return [texts.map(one => one.text), texts.filter(one => one.left < x + 10
              && one.left + one.wide > x - 10 && one.base - 11 < y + 10 && one.base + 3 > y - 10)
              .map(one => one.text)]
        """)
        assert (texts.count("r0.1.3"), within) == (1, []), scale


def test_a_number_and_its_unit_are_on_one_line(page: Browser):
    """Beside the scroll bar of a long answer, the m of the lens's height was on a line of its own."""
    page.run("document.getElementById('tab-photo').click();"
             "document.getElementById('answer').style.minHeight = '2000px'")  # fmt: skip
    lines = at_widths(page, (320, 900, 1280), """
        return ["height_m", "hfov"].map(name => {
          const input = document.getElementById(name), unit = document.createRange();
          unit.selectNode(input.nextSibling);
          return unit.getBoundingClientRect().top < input.getBoundingClientRect().bottom;
        })
    """)  # fmt: skip
    assert lines == {width: [True, True] for width in (320, 900, 1280)}


def test_a_browser_that_cannot_draw_says_so(page: Browser):
    assert page.run("return document.getElementById('undrawn').hidden")
    page.run("mapweave.painter.worker.dispatchEvent(new ErrorEvent('error'))")
    assert "cannot draw the map" in page.run("return document.querySelector('#map [role=alert]').innerText")


def test_fingers_hit_every_button(page: Browser, services: StubServices):
    services.fleet = FleetStatus((RobotEntry("r0", True),))
    page.look(390, 844, mobile=True)
    try:
        eventually(lambda: page.run("return document.querySelectorAll('#robots button').length"))
        small = page.run("""
            return [...document.querySelectorAll("button, a, select, input")].filter(one => {
              const { width, height } = one.getBoundingClientRect();
              return width && (width < 24 || height < 24);
            }).map(one => one.outerHTML)
        """)
    finally:
        page.look(420, 800)
    assert small == []


def test_screen_readers_name_every_control(page: Browser, services: StubServices):
    """By the accessibility tree that Chromium gives them, panel by panel."""
    services.fleet = FleetStatus((RobotEntry("r0", True),))
    eventually(lambda: page.run("return document.querySelectorAll('#robots button').length"))
    seen, nameless = set(), []
    for panel in ("fleet", "selected", "why", "edit", "photo"):
        Person(page).open(panel)
        for node in page.devtools("Accessibility.getFullAXTree")["nodes"]:
            role = node.get("role", {}).get("value")
            if role in CONTROLS and not node["ignored"]:
                seen.add(role)
                if not node.get("name", {}).get("value", "").strip():
                    nameless.append((panel, role, node["nodeId"]))
    assert not nameless and len(seen) > 6, seen


def test_no_button_touches_another_one(page: Browser):
    near = at_widths(page, (320, 390, 1280), """
        const found = [];
        for (const panel of ["fleet", "why", "edit", "photo"]) {
          document.getElementById(`tab-${panel}`).click();
          const all = [...document.querySelectorAll(`#${panel} :is(button, input, select)`)];
          const seen = all.filter(one => one.checkVisibility());
          const boxes = seen.map(one => [one.id || one.textContent, one.getBoundingClientRect()]);
          boxes.forEach(([name, a], k) => {
            for (const [other, b] of boxes.slice(k + 1)) {
              const x = Math.max(a.left, b.left) - Math.min(a.right, b.right);
              const y = Math.max(a.top, b.top) - Math.min(a.bottom, b.bottom);
              if (Math.max(x, y) < 2) found.push(`${name} and ${other}: ${x}, ${y}`);
            }
          });
        }
        return found;
    """, phones=True)  # fmt: skip
    assert near == {width: [] for width in (320, 390, 1280)}


def test_components_that_grow_keep_their_order(page: Browser):
    """Of two robots that map, the one with more nodes was drawn above the other, and they changed places."""
    above = page.run("""
        return import('/static/map_model.js').then(({ MapModel }) => {
          const model = new MapModel(), above = [];
          // Components by number of nodes: whose they are, and their nodes, 1 m apart.
          const grown = [[["r0.1.1", 2]], [["r0.1.1", 2], ["r1.1.1", 1]], [["r1.1.1", 9], ["r0.1.1", 3]],
            [["r2.1.1", 40], ["r0.1.1", 30], ["r1.1.1", 20]]];
          for (const sizes of grown) {
            const count = sizes.reduce((sum, [, nodes]) => sum + nodes, 0);
            const all = n => new Array(count).fill(n);
            const component = sizes.flatMap(([, nodes], k) => new Array(nodes).fill(k));
            const x = sizes.flatMap(([, nodes]) => [...new Array(nodes).keys()]);
            Object.assign(model, { components: sizes.map(([anchor]) => ({ anchor })),
              nodes: { count, x, y: all(0), component, state: all(1), map: all(0), number: all(0) } });
            model.arrange();
            const placed = sizes.map(([anchor], k) => [anchor, ...model.offset(k)]);
            placed.sort((a, b) => b[2] - a[2] || a[1] - b[1]);
            above.push(placed.map(([anchor]) => anchor).join(" "));
          }
          return above;
        })
    """)
    assert above == ["r0.1.1", "r0.1.1 r1.1.1", "r0.1.1 r1.1.1", "r0.1.1 r1.1.1 r2.1.1"]


def test_a_map_without_room_is_drawn_when_it_has_some(page: Browser):
    """As on a phone, where the keyboard may leave none."""
    eventually(lambda: page.run("return mapweave.painter.bitmap !== null"))
    page.run("document.getElementById('map').style.display = 'none'")
    eventually(lambda: page.run("return mapweave.viewport.width") == 0)
    page.run("mapweave.painter.changed()")
    page.run("document.getElementById('map').style.display = ''")
    eventually(lambda: page.run("return mapweave.viewport.width") > 0)
    drawn = "const p = mapweave.painter; return !p.stale && !p.waiting && p.drawn.scale === p.viewport.scale"
    eventually(lambda: page.run(drawn))
    assert page.run("return document.getElementById('undrawn').hidden")


def test_robots_of_a_server_that_is_gone_are_not_alive(browser: Browser, services: StubServices):
    """They stayed green, and their arrows on the map as where they are."""
    services.fleet = FleetStatus((RobotEntry("r0", True, 0.2),))
    person = Person(browser)
    with Web(("127.0.0.1", 0), services) as served:
        browser.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: "r0 alive" in person.text("robots"))
        browser.run("document.querySelector('#robots button').click()")
        # What stops it lies above all that changes its height.
        above = (
            "const top = one => one.getBoundingClientRect().top;"
            "const buttons = document.querySelectorAll('#selected button');"
            "return top([...buttons].find(one => one.textContent === 'Stop'))"
            " < top(document.querySelector('#selected dl'))"
        )
        assert browser.run(above)
    eventually(lambda: "r0 as last shown" in person.text("robots"))
    assert "alive" not in person.text("selected")
    assert "last heardbefore the map server was gone" in person.text("selected")


def test_no_choice_of_a_form_is_cut_off(page: Browser):
    page.look(1280, 800)
    page.run("document.getElementById('tab-edit').click()")
    cut = """
const c = document.createElement('canvas').getContext('2d'), cut = [];
const kinds = document.getElementById('edit-kind');
for (const kind of [...kinds.options].map(one => one.value)) {
  kinds.value = kind;
  kinds.dispatchEvent(new Event('change'));
  for (const one of document.querySelectorAll('#edit select')) {
    if (!one.checkVisibility()) continue;
    const style = getComputedStyle(one), px = name => parseFloat(style[name]);
    const room = one.clientWidth - px('paddingLeft') - px('paddingRight');
    c.font = style.font;
    // The arrow takes some of it.
    for (const { text } of one.options) if (c.measureText(text).width > room - 16) cut.push(text);
  }
}
return cut"""
    assert page.run(cut) == []


def test_an_angle_is_never_minus_nothing(page: Browser):
    degrees = "return import('/static/dom.js').then(({ degrees }) => [-0.001, 0.5, -3.2].map(degrees))"
    assert page.run(degrees) == ["0°", "29°", "-183°"]


def test_lists_that_change_keep_what_is_pressed_or_has_the_focus(page: Browser, services: StubServices):
    """Each status made all of them again: a click that a status came into was lost, and so was the focus."""
    services.said = Annotations((Annotation("hall", Place(NodeId("r0", 1, 1)), False, "anna", 1),))
    services.fleet = FleetStatus((RobotEntry("r0", True), RobotEntry("r1", True)))
    person = Person(page)
    eventually(lambda: "r1" in person.text("robots") and "hall" in person.text("places"))
    x, y = page.run(
        "const box = document.querySelector('#robots li:nth-child(2) button').getBoundingClientRect();"
        "return [box.left + 5, box.top + 5]"
    )
    mouse = {"x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1}
    page.devtools("Input.dispatchMouseEvent", type="mousePressed", **mouse)
    services.fleet = FleetStatus(tuple(RobotEntry(name, True) for name in ("r0", "r1", "r2")))
    eventually(lambda: "r2" in person.text("robots"))
    page.devtools("Input.dispatchMouseEvent", type="mouseReleased", **mouse)
    eventually(lambda: "Robot r1" in person.text("selected"))
    services.fleet = FleetStatus((RobotEntry("r1", False), RobotEntry("r3", True)))
    eventually(lambda: person.text("robots") == "r1 gone not on the mapr3 alive not on the map")
    # With the keyboard.
    person.press("tab-fleet")
    focused = "return document.activeElement.textContent"
    page.run("document.querySelector('#components button').focus()")
    services.map = less(two_maps())
    eventually(lambda: "12 nodes" not in person.text("components"))
    assert page.run(focused) == "component 0"
    page.run("document.querySelector('#places button').focus()")
    services.said = Annotations(
        (Annotation("attic", Place(NodeId("r0", 1, 1)), False, "anna", 1), *services.said.made)
    )
    page.run("document.dispatchEvent(new CustomEvent('mapchanged'))")
    eventually(lambda: "attic" in person.text("places"))
    assert page.run(focused) == "hall"


def test_numbers_in_events_are_no_names_of_maps(page: Browser, services: StubServices):
    """The position of a goal was a button, and there was no map 1.9."""
    words = "r0: go to r0.1.5 (1.9,-0.25) via r0.1 and b-2.1.7, after 12.5 s"
    services.events = (MapEvent(10**18, MapEventKind.COMMANDED, words),)
    eventually(lambda: words in page.run(text_of("history")))
    buttons = "return [...document.querySelectorAll('#history button')].map(one => one.textContent)"
    assert page.run(buttons) == ["r0.1.5", "r0.1", "b-2.1.7"]


def test_who_a_robot_waits_for_and_where_it_is_sent_are_said(page: Browser, services: StubServices):
    """Of a robot that waits the list said for no one, and of a goal with a name the panel said no node."""
    doing = Status("waiting for another robot", "r1 drives there", 1, 8, Pose2(), False)
    order = MissionOrder("m1", "r0", MissionKind.GO, 1, "anna", NodeId("r0", 1, 5), "kitchen")
    mission = MissionReport(order, MissionState.RUNNING, 0.25)
    said = AgentStatus(doing, 10**18, "r0", 1, mission=mission)
    services.fleet = FleetStatus((RobotEntry("r0", True, 0.1, said), RobotEntry("r1", True)))
    person = Person(page)
    eventually(lambda: "r0 alive waiting for another robot: r1 drives there, not" in person.text("robots"))
    aside = replace(
        said, status=replace(doing, doing="stepping aside for another robot", detail="r1 is to pass")
    )
    services.fleet = FleetStatus((RobotEntry("r0", True, 0.1, aside), RobotEntry("r1", True)))
    eventually(lambda: "r0 alive stepping aside for another robot: r1 is to pass" in person.text("robots"))
    page.run("document.querySelector('#robots button').click()")
    eventually(lambda: "go to kitchen (r0.1.5), running 25" in person.text("selected"))


ZOOMED = """
const p = mapweave.painter, post = p.worker.postMessage, asked = [];
p.worker.postMessage = message => asked.push(message.view);
for (let k = 0; k < 50; k++) { mapweave.viewport.zoom(1.01); p.waiting = false; p.refresh(); }
p.worker.postMessage = post;
p.waiting = false;
const { drawn: { scale }, viewport: now } = p;
return [Math.min(...asked.map(view => view.scale)) / scale, now.scale / scale];
"""
"""Zooms in by steps; the first scale at which the worker is asked, and the last, by what is drawn."""
SHARP = "const p = mapweave.painter; return !p.waiting && p.drawn?.scale === mapweave.viewport.scale"


def test_while_the_map_is_zoomed_its_bitmap_is_scaled_and_sharp_at_rest(page: Browser):
    """A bitmap was drawn for each step: at 20 000 nodes the worker took a core that the page had need of."""
    eventually(lambda: page.run(SHARP))
    first, last = page.run(ZOOMED)
    assert 1.5 < first < 1.52 and last > 1.6
    eventually(lambda: page.run(SHARP))
