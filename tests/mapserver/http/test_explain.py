"""Why maps are one, over HTTP and on the page in a real browser: the numbers are those of the merged map."""

import json
from concurrent.futures import Future
from dataclasses import replace
from itertools import pairwise
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import pytest

from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.explanation import Explanation, FleetExplanation
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.query import ExplainRequest
from mapweave.mapserver.http.json_values import json_values
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.routes import Router
from mapweave.merge.explanation.map_explanation import explain_fleet, explain_maps
from mapweave.merge.explanation.node_explanation import explain_nodes
from synthetic.maps import looked_around, merger_of
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.stub_services import StubServices, two_maps
from tests.waiting import eventually

RESULT = "return document.getElementById('result').textContent"
LINKS = "return [...document.querySelectorAll('#result a')].map(a => a.textContent)"


def count(kind: str) -> str:
    return f"return document.querySelectorAll('#result svg {kind}').length"


def ask(served: Web, query: str, of: str = "explain") -> tuple[int, dict]:
    try:
        with urlopen(f"http://127.0.0.1:{served.port}/{of}{query}", timeout=20) as reply:
            return reply.status, json.load(reply)
    except HTTPError as error:
        return error.code, json.load(error)


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """What a first explanation compiles takes longer on a busy machine than a person would wait."""
    explain_fleet(two_maps(), 10)


def test_maps_and_nodes_are_explained(served: Web):
    status, result = ask(served, "")
    (one,) = result["maps"]
    assert status == 200 and one["joined"] and (one["first"], one["second"]) == ("r0.1", "r1.1")
    assert ask(served, "?a=r1.1&b=r0.1") == (200, result)
    weakest = one["nearest"][0]
    status, pair = ask(served, f"?a={weakest['b']}&b={weakest['a']}")
    merged = two_maps()
    link = next(link for link in merged.links if str(link.a) == weakest["a"] and str(link.b) == weakest["b"])
    assert status == 200 and pair["standing"] == "linked" and pair["shared"] == link.shared.tolist()
    assert np.allclose(pair["a_from_b"]["covariance"], link.a_from_b.covariance)
    for side, end in zip("ab", link.pair, strict=True):
        node = merged.maps[end.map].nodes[end]
        assert pair[side]["id"] == str(end)
        assert pair[side]["image"] == [node.camera.width, node.camera.height]
        assert np.allclose(pair[side]["pixels"], node.landmarks.pixels, atol=0.051)


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("?a=r0.1", "write /explain"),
        ("?a=r0.1&b=r1.1&c=1", "write /explain"),
        ("?a=r0.1&b=", "'' is no place of this map: give a node"),
        ("?a=r0.1&b=r1.1&via=r0.1.1", "write /explain"),
        ("?a=r0.1&b=r1.1.1", "a node and a map"),
        ("?a=r0.1&b=r0.1", "give two maps"),
        ("?a=r0.1.1&b=r9.1.1", "there is no map r9.1; known are: r0.1, r1.1"),
    ],
)
def test_unknown_nodes_are_reported_in_one_line(served: Web, query: str, words: str):
    status, result = ask(served, query)
    assert status == 400 and words in result["error"] and "\n" not in result["error"]


def test_a_route_leads_over_what_it_must_pass(served: Web):
    start, first, second, goal = "r0.1.1", "r1.1.7", "r0.1.3", "r1.1.1"
    legs = [ask(served, f"?a={a}&b={b}", "route")[1] for a, b in pairwise((start, first, second, goal))]
    status, way = ask(served, f"?a={start}&b={goal}&via={first}&via={second}", "route")
    assert status == 200 and way["found"] and (way["start"], way["goal"]) == (start, goal)
    assert way["hops"] == [hop for leg in legs for hop in leg["hops"]]
    assert {first, second} <= {hop["b"] for hop in way["hops"]}
    assert all(f"{leg['start']} to {leg['goal']}: {leg['reason']}" in way["reason"] for leg in legs)
    for query, words in (
        (f"?a={start}&b={goal}&via=nowhere", "'nowhere' is no place of this map"),
        (f"?a=0,0&b={goal}&near=nowhere", "'nowhere' is no place of this map"),
        (f"?a={start}&b={goal}&via=r0.1", "r0.1.1 and r0.1 are a node and a map"),
        (f"?a={start}&via={goal}", "write /route?a=r0.1.17&b=r1.1.5: "),
        (f"?a={start}&b={goal}{17 * f'&via={first}'}", "at most 16 places"),
    ):
        status, result = ask(served, query, "route")
        assert status == 400 and words in result["error"] and "\n" not in result["error"], result


def test_a_busy_server_gives_a_retry_time(served: Web, services: StubServices):
    services.refusal = Busy(0.5)
    status, result = ask(served, "")
    assert status == 503 and result["retry_after"] == 0.5


@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_the_page_leads_from_maps_to_landmarks(served: Web, browser: Browser):
    browser.open(f"http://127.0.0.1:{served.port}/why")
    eventually(lambda: "r0.1 and r1.1 are one map: " in browser.run(RESULT))
    a, b = (NodeId.parse(word) for word in browser.run(LINKS)[0].split(" - "))
    browser.run("document.querySelector('#result a').click()")
    eventually(lambda: f"{a} and {b}: linked: " in browser.run(RESULT))
    explanation = explain_nodes(two_maps(), a, b)
    assert browser.run(count(".agree")) == len(explanation.shared)
    assert browser.run(count(".alike")) == len(explanation.matches) - len(explanation.shared)
    assert browser.run(count("circle")) == len(explanation.a.landmarks) + len(explanation.b.landmarks)
    assert f"{explanation.a_from_b.mean.x:.3f} m ahead" in browser.run(RESULT)
    # The address shows the same page at once, and the back button works.
    address = browser.run("return location.href")
    assert address.endswith(f"/why?a={a}&b={b}")
    browser.run("document.getElementById('all').click()")
    eventually(lambda: "r0.1 and r1.1 are one map: " in browser.run(RESULT))
    browser.open(address)
    eventually(lambda: f"{a} and {b}: linked: " in browser.run(RESULT))
    browser.open(f"http://127.0.0.1:{served.port}/why?a=r1.1&b=%20r0.1%20")
    eventually(lambda: "r0.1 and r1.1 are one map: " in browser.run(RESULT))
    assert browser.run("return ['a', 'b'].map(name => document.getElementById(name).value)") == [
        "r1.1",
        "r0.1",
    ]
    browser.open(f"http://127.0.0.1:{served.port}/why?a=r0.1&b=%3Cb%3Ex")
    eventually(lambda: "'<b>x' is no place of this map: give a node" in browser.run(RESULT))
    assert browser.run("return document.querySelector('#result b')") is None
    assert browser.run("return document.querySelectorAll('b').length") == 0


@pytest.mark.slow
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_the_page_shows_the_route_of_its_form_and_of_its_address(served: Web, browser: Browser):
    start, goal = NodeId("r0", 1, 1), NodeId("r1", 1, 7)
    explanation = explain_route(Router(two_maps()), start, goal)
    assert explanation.found and ask(served, f"?a={start}&b={goal}", "route") == (
        200,
        json_values(explanation),
    )
    browser.open(f"http://127.0.0.1:{served.port}/why")
    browser.type("#a", str(start))
    browser.type("#b", str(goal))
    browser.run("document.querySelector('[name=route]').click()")
    eventually(lambda: f"{start} to {goal}: the route is: {explanation.reason}" in browser.run(RESULT))
    assert browser.run(LINKS) == [f"{hop.a} - {hop.b}" for hop in explanation.hops]
    # On the map, too, all of it in view; a step is there alone once it is asked about.
    steps = "return mapweave.painter.ways.map(way => `${way.a} - ${way.b}`)"
    assert browser.run(steps) == [f"{hop.a} - {hop.b}" for hop in explanation.hops]
    browser.run("mapweave.viewport.show(99, 99)")
    browser.run("document.querySelector('[name=route]').click()")
    inside = (
        "const m = mapweave.model, v = mapweave.viewport; return mapweave.painter.ways.every(({ a }) => {"
        "const row = m.rowOf(a), [x, y] = v.toScreen(m.x[row], m.y[row]);"
        "return x > 0 && y > 0 && x < v.width && y < v.height })"
    )
    eventually(lambda: browser.run(inside))
    address = browser.run("return location.href")
    assert address.endswith(f"/why?a={start}&b={goal}&route=1")
    browser.open(f"http://127.0.0.1:{served.port}/why")
    browser.open(address)
    eventually(lambda: f"{start} to {goal}: the route is" in browser.run(RESULT))
    browser.run("document.querySelector('#result a').click()")
    eventually(lambda: f"{explanation.hops[0].a} and {explanation.hops[0].b}: " in browser.run(RESULT))
    assert browser.run(steps) == [f"{explanation.hops[0].a} - {explanation.hops[0].b}"]


@pytest.mark.slow
@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_the_history_is_listed_newest_first_and_goes_on(
    served: Web, services: StubServices, browser: Browser
):
    shown = "return [...document.querySelectorAll('#history li')].map(one => one.textContent)"
    services.events = (MapEvent(10**18, MapEventKind.JOINED, "r0.1 and r1.1 are one map now"),)
    browser.open(f"http://127.0.0.1:{served.port}/")
    joined = "2001-09-09 01:46:40 UTC joined: r0.1 and r1.1 are one map now"
    eventually(lambda: browser.run(shown) == [joined])
    services.events += (MapEvent(10**18 + 7 * 10**9, MapEventKind.PARTED, "<b>x"),)
    eventually(lambda: browser.run(shown) == ["2001-09-09 01:46:47 UTC parted: <b>x", joined])


def test_the_history_is_listed_with_times(served: Web, services: StubServices):
    services.events = (MapEvent(10**18, MapEventKind.CONSTRAINED, "no"),)
    with urlopen(f"http://127.0.0.1:{served.port}/history", timeout=20) as reply:
        (event,) = json.load(reply)["history"]
    assert event == {"stamp_ns": 10**18, "time": "2001-09-09 01:46:40", "kind": "constrained", "words": "no"}


def test_a_way_leads_from_node_to_node(served: Web):
    for query, words in (("", "write /route?a="), ("?a=r0.1&b=r1.1", "from node to node")):
        status, result = ask(served, query, "route")
        assert status == 400 and words in result["error"]


@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_maps_that_are_one_by_way_of_others_show_the_way_on_the_page(
    served: Web, services: StubServices, browser: Browser, monkeypatch
):
    """And what is held against maps, which the shell says too."""
    ids = tuple(MapId(name, 1) for name in ("r0", "r1", "r2"))
    merged = merger_of(looked_around(ids, seed=6)).merged()
    far = {ids[0], ids[2]}
    links = tuple(link for link in merged.links if {link.a.map, link.b.map} != far)
    assert 0 < len(links) < len(merged.links)
    merged = replace(merged, links=links)

    def explain(request: ExplainRequest) -> Future[Explanation]:
        done: Future[Explanation] = Future()
        pair = (ids[0], ids[2]) if request.ends is None else tuple(MapId(*end[:2]) for end in request.ends)
        # The page needs the steps, however they are worded.
        explanation = replace(explain_maps(merged, *pair), reason=f"as {pair[0]} and {pair[1]} are")
        done.set_result(FleetExplanation((explanation,), () if request.ends else ("r2.1 is bent",)))
        return done

    monkeypatch.setattr(services, "explain", explain)
    browser.open(f"http://127.0.0.1:{served.port}/why")
    eventually(lambda: "as r0.1 and r2.1 are" in browser.run(RESULT))
    assert browser.run(LINKS) == ["r0.1 - r1.1", "r1.1 - r2.1"]
    assert "r2.1 is bent" in browser.run(RESULT)
    browser.run("document.querySelectorAll('#result a')[1].click()")
    eventually(lambda: "as r1.1 and r2.1 are" in browser.run(RESULT))
    assert browser.run("return location.search") == "?a=r1.1&b=r2.1"
    assert "By way of" not in browser.run(RESULT)
