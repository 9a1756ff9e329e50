"""The page by touch, by keyboard and with a screen reader, in a real browser."""

import json
import math
from collections.abc import Iterator

import pytest

from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.mapserver.http.web import Web
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person
from tests.mapserver.stub_services import StubServices
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")

FOCUSED = "const one = document.activeElement; return one.id || one.textContent"
PAGE_MOVED = "return [scrollX, scrollY, visualViewport.scale, visualViewport.offsetTop]"
FORCED = [{"name": "forced-colors", "value": "active"}]

Finger = tuple[float, float]

CONTRASTS = """
const rgb = text => (text.match(/[\\d.]+/g) || []).map(Number);
const luminance = ([r, g, b]) => [r, g, b].map(one => one / 255)
  .map(one => one <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4)
  .reduce((sum, one, k) => sum + one * [0.2126, 0.7152, 0.0722][k], 0);
const behind = one => {
  for (let at = one; at; at = at.parentElement) {
    const [r, g, b, opaque = 1] = rgb(getComputedStyle(at).backgroundColor);
    if (opaque > 0) return [r, g, b];
  }
  return [255, 255, 255];
};
const low = [];
const check = (one, style, words) => {
  const [a, b] = [luminance(rgb(style.color)), luminance(behind(one))].sort((x, y) => y - x);
  const ratio = (a + 0.05) / (b + 0.05);
  if (ratio < 4.5) low.push(`${words.trim().slice(0, 30)}: ${ratio.toFixed(2)}`);
};
for (const one of document.querySelectorAll("body, body *")) {
  if (!one.checkVisibility() || one.closest("svg, :disabled")) continue;
  const own = [...one.childNodes].filter(node => node.nodeType === 3).map(node => node.data).join(" ");
  if (own.trim()) check(one, getComputedStyle(one), own);
  if (one.placeholder) check(one, getComputedStyle(one, "::placeholder"), one.placeholder);
}
return low;
"""


@pytest.fixture
def page(browser: Browser, services: StubServices) -> Iterator[Browser]:
    services.fleet = FleetStatus((RobotEntry("r0", True), RobotEntry("r1", True)))
    with Web(("127.0.0.1", 0), services) as served:
        browser.look(420, 800)
        browser.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: browser.run("return document.querySelectorAll('#robots button').length") == 2)
        eventually(lambda: browser.run("return mapweave.painter.bitmap !== null"))
        yield browser
        browser.look(420, 800)


@pytest.fixture
def phone(page: Browser) -> Browser:
    """The page on a phone with a touch screen."""
    page.look(390, 844, mobile=True)
    # All of the new layout: fingers are placed by it.
    settled = (
        "const { viewport: v, painter } = mapweave; return [v.width, v.height - painter.canvas.clientHeight]"
    )
    eventually(lambda: page.run(settled) == [390, 0])
    return page


def touch(page: Browser, *moments: dict[int, Finger]) -> None:
    """Touch the map, moment by moment, with fingers by their numbers; one that is no more there lifts.

    Positions are in px from the map's upper left corner.
    """
    left, top = page.run(
        "const box = mapweave.painter.canvas.getBoundingClientRect(); return [box.left, box.top]"
    )
    before: dict[int, Finger] = {}
    for now in [*moments, {}]:
        kind, changed = "touchMove", now
        if set(now) - set(before):
            kind = "touchStart"
        elif set(before) - set(now):
            kind, changed = "touchEnd", {one: before[one] for one in set(before) - set(now)}
        points = [{"x": left + u, "y": top + v, "id": number} for number, (u, v) in changed.items()]
        page.devtools("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        before = now


def plane(page: Browser, finger: Finger) -> tuple[float, float]:
    """What lies on the map at a point of the screen, m."""
    x, y = page.run(f"return mapweave.viewport.toPlane({finger[0]}, {finger[1]})")
    return x, y


def along(start: Finger, end: Finger, steps: int = 8) -> list[Finger]:
    """Points of a straight way, the end included."""
    return [
        (start[0] + (end[0] - start[0]) * k / steps, start[1] + (end[1] - start[1]) * k / steps)
        for k in range(steps + 1)
    ]


def test_one_finger_moves_the_map_and_not_the_page(phone: Browser):
    start, end = (150.0, 120.0), (230.0, 200.0)
    held, scale = plane(phone, start), phone.run("return mapweave.viewport.scale")
    page_before = phone.run(PAGE_MOVED)
    touch(phone, *({0: finger} for finger in along(start, end)))
    assert plane(phone, end) == pytest.approx(held), "what is under the finger stays under it"
    assert phone.run("return mapweave.viewport.scale") == scale
    assert phone.run(PAGE_MOVED) == page_before
    assert "Select a node" in Person(phone).text("selected"), "a drag chooses nothing"


@pytest.mark.parametrize("apart", [30.0, 160.0])
def test_two_fingers_zoom_the_map_and_not_the_page(phone: Browser, apart: float):
    """Two points of the map stay under two fingers, which moves and zooms it: closer, and farther."""
    first, other = (150.0, 150.0), (150.0 + 80.0, 150.0 + 60.0)  # 100 px
    # The same direction: a map does not turn.
    ends = (120.0, 100.0), (120.0 + 0.8 * apart, 100.0 + 0.6 * apart)
    held = plane(phone, first), plane(phone, other)
    scale, page_before = phone.run("return mapweave.viewport.scale"), phone.run(PAGE_MOVED)
    ways = zip(along(first, ends[0]), along(other, ends[1]), strict=True)
    touch(phone, {0: first}, *({0: one, 1: two} for one, two in ways))
    for finger, point in zip(ends, held, strict=True):
        assert plane(phone, finger) == pytest.approx(point, abs=1e-6)
    assert phone.run("return mapweave.viewport.scale") == pytest.approx(scale * apart / 100.0)
    assert phone.run(PAGE_MOVED) == page_before
    assert "Select a node" in Person(phone).text("selected")


def test_a_finger_that_stays_after_two_moves_the_map_on(phone: Browser):
    """Without a jump, and without choosing what it lifts from."""
    one, two, end = (120.0, 120.0), (200.0, 180.0), (160.0, 90.0)
    touch(phone, {0: one}, {0: one, 1: two}, {0: one, 1: (230.0, 200.0)}, {0: one})
    held = plane(phone, one)
    touch(phone, {0: one}, {0: one, 1: two}, {0: one}, *({0: finger} for finger in along(one, end)))
    assert plane(phone, end) == pytest.approx(held)
    assert "Select a node" in Person(phone).text("selected")


def test_a_tap_chooses_a_node(phone: Browser):
    """So close that the nodes, which stand centimetres apart, are apart on the screen."""
    u, v = phone.run(
        "const m = mapweave.model, row = m.rowOf('r0.1.1'), v = mapweave.viewport;"
        "v.show(m.x[row], m.y[row], 2000); mapweave.painter.ask(); return v.toScreen(m.x[row], m.y[row])"
    )
    touch(phone, {0: (u + 3.0, v - 2.0)})
    eventually(lambda: "Node r0.1.1" in Person(phone).text("selected"))


def test_the_focus_goes_where_a_choice_leads(page: Browser):
    """It was lost with what was pressed: the next key began at the top of the page."""
    person = Person(page)
    page.run("document.querySelector('#robots button').focus()")
    person.key("Enter", "\r")
    eventually(lambda: page.run(FOCUSED) == "Robot r0")
    # Among the panel's own: the heading's, then those that follow it.
    person.key("Tab")
    eventually(lambda: page.run(FOCUSED) == "goal")
    page.run("mapweave.painter.canvas.focus()")
    person.key("n", "n")
    eventually(lambda: page.run("return document.querySelectorAll('#selected li button').length") > 1)
    assert page.run(FOCUSED) == "canvas", "the next key goes to the map again"
    other = page.run(
        "const one = document.querySelector('#selected li button'); one.focus(); return one.textContent"
    )
    person.key("Enter", "\r")
    eventually(lambda: page.run(FOCUSED) == f"Node {other}")
    page.run("document.querySelector('#selected li button + button').focus()")
    person.key("Enter", "\r")
    eventually(lambda: page.run(FOCUSED) == "why")


def test_what_is_selected_on_the_map_is_announced(page: Browser):
    """By key, or by the search: the focus stays where it was, and a screen reader said nothing."""
    person = Person(page)
    page.run("mapweave.painter.canvas.focus()")
    for key, text in (("n", "n"), ("n", "n"), ("p", "p")):
        person.key(key, text)
        name = page.run("return mapweave.page.node")
        assert person.text("announcement") == f"Node {name}"
    page.run("document.getElementById('query').focus()")
    person.fill("query", "r1")
    person.key("Enter", "\r")
    eventually(lambda: person.text("announcement") == "Robot r1")


def test_a_status_that_stays_is_not_read_again(page: Browser, services: StubServices):
    """Firefox reports each text that is set: "live" was read out twice a second."""
    page.run("""
        window.written = [];
        const inherited = Object.getOwnPropertyDescriptor(Node.prototype, "textContent");
        for (const one of document.querySelectorAll("[role=status]"))
          Object.defineProperty(one, "textContent", { get() { return inherited.get.call(this); },
            set(words) { written.push(one.id); inherited.set.call(this, words); } });
    """)
    for count in (3, 4):
        services.fleet = FleetStatus(tuple(RobotEntry(f"r{k}", True) for k in range(count)))
        eventually(lambda count=count: f"r{count - 1}" in Person(page).text("robots"))
    assert page.run("return written") == []


def test_the_page_has_one_heading_and_its_landmarks_on_every_screen(page: Browser):
    """On a phone the title was not there for screen readers either."""
    for width, mobile in ((1280, False), (390, True)):
        page.look(width, 800, mobile=mobile)
        tree = page.devtools("Accessibility.getFullAXTree")["nodes"]
        nodes = [node for node in tree if not node["ignored"]]
        titles = [
            node["properties"]
            for node in nodes
            if (node["role"]["value"], node["name"]["value"]) == ("heading", "Mapweave")
        ]
        assert len(titles) == 1
        assert {"name": "level", "value": {"type": "integer", "value": 1}} in titles[0]
        assert {"main", "search", "complementary", "tablist"} <= {node["role"]["value"] for node in nodes}


def test_visible_words_are_part_of_the_names_that_are_spoken(page: Browser):
    """Who speaks to a computer says what is written on a button: "Fit" was "Show the whole map"."""
    differing = page.run("""
        return [...document.querySelectorAll("button[aria-label], a[aria-label]")].filter(one =>
          /\\w/.test(one.textContent) && one.checkVisibility() &&
          !one.getAttribute("aria-label").toLowerCase().includes(one.textContent.trim().toLowerCase())
        ).map(one => one.outerHTML)
    """)
    assert differing == []


def test_all_words_have_contrast_as_they_are_shown(page: Browser):
    """By the computed styles. The hints in fields had 4.3 to 1 in the light theme, 3.9 in the dark one."""
    low = {}
    for panel in ("fleet", "selected", "why", "events", "edit", "photo"):
        Person(page).open(panel)
        for scheme in ("light", "dark"):
            page.look(1280, 800, scheme)
            low[f"{panel}, {scheme}"] = page.run(CONTRASTS)
    assert not any(low.values()), json.dumps(low)


def test_the_open_tab_is_marked_in_colours_of_the_system(page: Browser):
    """Shadows and backgrounds are left out there: no tab looked open, and components had no colour."""
    page.devtools("Emulation.setEmulatedMedia", features=FORCED)
    widths = page.run(
        "return [...document.querySelectorAll('[role=tab]')].map(one =>"
        " [one.getAttribute('aria-selected'), parseFloat(getComputedStyle(one).borderBottomWidth)])"
    )
    assert all((width >= 2) == (selected == "true") for selected, width in widths), widths
    swatch, panel = page.run(
        "return ['.swatch', 'aside'].map(one =>"
        " getComputedStyle(document.querySelector(one)).backgroundColor)"
    )
    assert swatch != panel
    # What is disabled has the system's colour for it, and was half transparent beside that.
    opacities = page.run(
        "return [...document.querySelectorAll('button:disabled')].map(one => getComputedStyle(one).opacity)"
    )
    assert opacities and set(opacities) == {"1"}


def test_a_small_or_enlarged_page_scrolls_one_way(page: Browser):
    """1280x1024 px at 400 %, and a small phone on its side: the panel was 34 px high."""
    page.run("document.querySelector('#robots button').click()")
    for width, height in ((320, 256), (667, 375)):
        page.look(width, height, mobile=True)
        wide, panel, of_panel, drawn = page.run("""
            const panel = document.getElementById("selected"), { canvas } = mapweave.painter;
            return [document.documentElement.scrollWidth, panel.clientHeight, panel.scrollHeight,
              canvas.getBoundingClientRect().height]
        """)
        assert wide == width
        assert panel >= of_panel and panel > 0.5 * height, "all of it is reached by scrolling the page"
        assert drawn > 0.5 * height
        eventually(lambda d=drawn: math.isclose(d, page.run("return mapweave.viewport.height"), abs_tol=1.0))
