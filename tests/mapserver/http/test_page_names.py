"""Names on the page in a real browser: typed for nodes, replaced, restored; floors and time windows."""

from collections.abc import Iterator

import pytest

from mapweave.hybridmap.annotation import Annotation, Place
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.constraint_subject import RetiredWindow
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person, annotation, last, opened
from tests.mapserver.test_corrections import FIRST, LAST, A
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
NAMES = "return mapweave.selection.names"
DISABLED = "return ['edit-check', 'edit-apply'].map(name => document.getElementById(name).disabled)"
CORRECTIONS = "return [...document.querySelectorAll('#corrections li')].map(one => one.textContent)"
PLACES = "return [...document.querySelectorAll('#places li')].map(one => one.textContent)"
KEEP_ANNOUNCED = """
window.announced = "";
const keep = new MutationObserver(changes => {
  for (const { addedNodes } of changes)
    for (const words of addedNodes) window.announced += words.textContent + "\\n";
});
keep.observe(document.getElementById("announcement"), { childList: true });
"""


@pytest.fixture
def person(browser: Browser, server: MapServer) -> Iterator[Person]:
    with Web(("127.0.0.1", 0), server) as served:
        yield opened(browser, served.port)


def name_place(person: Person, name: str, nodes: str) -> None:
    person.fill("edit-nodes", nodes)
    said = person.edit("place", "it is so", name=name)
    assert "only checked" in said, said
    person.apply()
    eventually(lambda: f"{name} place" in person.page.run(PLACES))


def test_a_name_that_is_not_known_leaves_nothing_to_apply(person: Person, server: MapServer):
    page = person.page
    person.fill("edit-nodes", str(LAST))
    assert "only checked" in person.edit("retire", "dark")
    assert page.run(DISABLED) == [False, False]
    for word, says in (
        ("kitchen", "Neither a node nor a place is called \u201ckitchen\u201d."),
        ("90,90", "Nothing is mapped within 2 m"),
    ):
        person.fill("edit-nodes", word)
        assert says in person.text("edit-counts")
        assert page.run(NAMES) == [] and page.run(DISABLED) == [True, True]
        assert page.run("return document.getElementById('edit-nodes').value") == word
    person.fill("edit-nodes", str(LAST))
    assert page.run(NAMES) == [str(LAST)] and page.run(DISABLED) == [False, True]
    assert not server.constraints().made


def test_places_and_positions_stand_for_nodes(person: Person, server: MapServer):
    page = person.page
    name_place(person, "east", str(FIRST))
    name_place(person, "east wing", str(LAST))
    (x, y) = server.merged().pose(LAST).vector[:2]
    component = server.merged().component_of(LAST)
    typed = [("east wing", [LAST]), ("east", [FIRST]), ("east wing, east", [LAST, FIRST])]
    typed.append((f"{A}.1 east", None))
    if component == 0:
        typed += [(f"{x:.3f},{y:.3f}", [LAST]), (f"{FIRST}, {x:.3f}, {y:.3f}", [FIRST, LAST])]
    for text, nodes in typed:
        person.fill("edit-nodes", text)
        assert page.run(NAMES) == list(map(str, nodes or [f"{A}.1", FIRST]))
    # The name of an area alone is the area.
    page.run("document.getElementById('draw-rectangle').click()")
    (u, v), (r, s) = person.at(LAST), person.at(LAST)
    person.mouse((u - 30, v - 30), (r, s), (r + 30, s + 30))
    eventually(lambda: page.run("return mapweave.selection.area !== null"))
    area = page.run("return mapweave.selection.area")
    page.run(KEEP_ANNOUNCED)
    person.edit("place", "it is so", name="the hall")
    person.apply()
    eventually(lambda: "the hall place" in page.run(PLACES))
    # Its event comes a moment later, and is announced over what a search has said; others may come over it.
    eventually(lambda: "place the hall is an area" in page.run("return window.announced"))
    person.fill("edit-nodes", "the hall")
    assert page.run("return mapweave.selection.area.anchor") == area["anchor"]
    # The search takes the same words.
    person.search(f"{x:.3f}, {y:.3f}" if component == 0 else "east wing")
    person.shows(f"Node {LAST}")
    person.search("90,90")
    assert "Nothing is mapped within 2 m of 90,90" in person.text("announcement")


def test_what_another_person_says_is_shown_at_once(browser: Browser, server: MapServer):
    """A closure of another operator was seen up to 10 s later; the page looks so rarely by itself."""
    source = "window.setInterval = () => 0"
    script = browser.devtools("Page.addScriptToEvaluateOnNewDocument", source=source)
    try:
        with Web(("127.0.0.1", 0), server) as served:
            page = opened(browser, served.port).page
            for name in ("kitchen", "hall"):
                server.annotate(Annotation(name, Place(FIRST), False, "bob", 1))
                eventually(lambda name=name: f"{name} place" in page.run(PLACES))
    finally:
        browser.devtools("Page.removeScriptToEvaluateOnNewDocument", identifier=script["identifier"])


AROUND = """
const m = mapweave.model, row = m.rowOf('%s'), [left, bottom, right, top] = m.bounds();
const corners = [[left - %s, bottom], [right, bottom - %s], [right + %s, top], [left, top + %s]];
return corners.map(([x, y]) => m.toNode(row, x, y));
"""
HALL_IN_VIEW = """
const m = mapweave.model, row = m.rowOf('%s');
return %s.every(([x, y]) => mapweave.viewport.holds(...m.inNode(row, x, y), 0));
"""


def test_the_whole_map_is_shown_with_the_areas_that_people_have_named(person: Person, server: MapServer):
    """Of a hall that is wider than its nodes the edge was beyond the window."""
    page = person.page
    page.look(320, 600)
    wide, far = (page.run(AROUND % (FIRST, m, m, m, m)) for m in (0.9, 50.0))
    person.press("fit")
    scale = page.run("return mapweave.viewport.scale")
    # One that reaches very far makes nothing small.
    server.annotate(Annotation("town", Place(area=Area(FIRST, tuple(map(tuple, far)))), False, "bob", 1))
    eventually(lambda: any("town place" in one for one in page.run(PLACES)))
    person.press("fit")
    assert page.run("return mapweave.viewport.scale") == scale
    server.annotate(Annotation("hall", Place(area=Area(FIRST, tuple(map(tuple, wide)))), False, "bob", 1))
    eventually(lambda: page.run(HALL_IN_VIEW % (FIRST, wide)))
    person.press("fit")
    assert page.run(HALL_IN_VIEW % (FIRST, wide))


def test_a_place_that_was_replaced_is_restored(person: Person, server: MapServer):
    page = person.page
    name_place(person, "kitchen", str(FIRST))
    name_place(person, "kitchen", str(LAST))
    person.take_back(server)
    person.press("tab-events")
    eventually(lambda: len(page.run(CORRECTIONS)) == 3)
    _, second, first = page.run(CORRECTIONS)
    assert f"is node {LAST}" in second and "Restore" in second
    assert (
        f"is node {FIRST}" in first and "Replaced" in first and f"UTC: place kitchen is node {LAST}" in first
    )
    assert "Restore" not in first, "it holds already"
    page.run("document.querySelectorAll('#corrections li')[1].querySelector('button').click()")
    eventually(lambda: len(server.annotations().made) == 4)
    kitchen = server.annotations().last("place", "kitchen")
    assert kitchen is not None and kitchen.body.anchor == LAST


def test_floors_are_named_wherever_a_place_is_shown(person: Person, server: MapServer):
    page = person.page
    person.fill("edit-nodes", str(LAST))
    person.edit("floor", "stairs", label="ground")
    person.apply()
    assert annotation(server).name == str(LAST.map)
    eventually(lambda: f"{LAST.map} floor ground" in page.run(PLACES))
    eventually(lambda: "floor ground, " in person.text("components"))
    person.search(LAST)
    eventually(lambda: [*person.facts().items()][1:2] == [("floor", "ground")])


def test_a_time_window_is_retired(person: Person, server: MapServer):
    person.fill("edit-nodes", str(LAST))
    person.fill("edit-kind", "retire")
    shown = "return document.getElementById('edit-retire-begin').checkVisibility()"
    assert not person.page.run(shown)
    assert "give one of the times" in person.edit("retire", "a lamp was off", scope="window")
    assert person.page.run(shown)
    said = person.edit("retire", "a lamp was off", begin="1970-01-01T00:00:00", end="2031-03-01T12:00:05")
    assert "only checked" in said, said
    person.apply()
    window = last(server)
    assert isinstance(window, RetiredWindow) and window.map == LAST.map
    assert window.end_ns % (60 * 10**9) == 5 * 10**9


HOLD = """
const fetched = window.fetch;
window.held = 0;
window.holds = true;
window.released = new Promise(done => { window.release = done; });
window.fetch = async (...asked) => {
  const hold = window.holds, reply = await fetched(...asked);
  if (hold) { window.held++; await window.released; }
  return reply;
};
document.dispatchEvent(new Event('mapchanged'));
"""


def test_a_late_answer_does_not_replace_a_newer_one(person: Person, server: MapServer):
    """Lists of places and corrections went back to what they had been, until the next change."""
    page = person.page
    server.annotate(Annotation("kitchen", Place(FIRST), False, "bob", 1))
    eventually(lambda: "kitchen place" in page.run(PLACES) and len(page.run(CORRECTIONS)) == 1)
    page.run(HOLD)
    # Those of corrections and of what is said, once each by the event and once by what it was sent for.
    eventually(lambda: page.run("return window.held") >= 4)
    page.run("window.holds = false")
    server.annotate(Annotation("hall", Place(LAST), False, "bob", 1))
    eventually(lambda: "hall place" in page.run(PLACES) and len(page.run(CORRECTIONS)) == 2)
    page.run("window.release(); return fetch('plans').then(() => fetch('plans')).then(() => true)")
    assert "hall place" in page.run(PLACES) and len(page.run(CORRECTIONS)) == 2
