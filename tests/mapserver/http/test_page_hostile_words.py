"""Words of robots and of other people on the page in a real browser: shown as they are, and nothing else."""

import json
from collections.abc import Iterator

import pytest

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.annotation import Annotation, Floor, Place
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person, opened
from tests.mapserver.stub_services import StubServices
from tests.mapserver.test_corrections import FIRST
from tests.quick import first_quick
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
LONGEST = 255
"""Characters of what a robot says that it does."""
HOSTILE = {
    "html": "<img src=x onerror='window.broken = 1'><script>window.broken = 1</script>",
    "long": "W" * 60,
    "svg": "<svg onload='window.broken = 1'></text></svg>\"' onmouseover=window.broken=1",
    "address": "javascript:window.broken=1 ${window.broken=1} {{7*7}} &lt;b&gt; %3Cb%3E __proto__",
    "from right to left": "\u05d0\u05d1\u05d2 \u0627\u0644\u0639\u0631\u0628\u064a\u0629 r1 12.5 m",
    "heaps of marks": "\u00e1" + "\u0489\u0336" * 29,
}
"""All of it is printable, at most 64 characters for names; messages with other text are refused."""
MADE = (
    "return [...document.querySelectorAll('main img:not(#shown), main script, main [onload], main [onerror], "
    "main [onmouseover], main a[href^=javascript]')].map(one => one.outerHTML)"
)
SPREAD = "return document.documentElement.scrollWidth - window.innerWidth"


def harmless(page: Browser) -> None:
    """Nothing has run, no element was made of the words, and the page is as wide as its window."""
    assert page.run("return window.broken ?? 0") == 0
    assert page.run(MADE) == []
    assert page.run(SPREAD) <= 0
    # A stub of a server has no plans.
    assert [said for said in page.errors() if "Failed to load resource" not in said] == []


@pytest.fixture
def services() -> StubServices:
    return StubServices()


@pytest.fixture
def person(browser: Browser, services: StubServices) -> Iterator[Person]:
    with Web(("127.0.0.1", 0), services) as served:
        browser.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: browser.run("return window.mapweave?.model.order.length ?? 0"))
        # The page of before has lost its server.
        browser.errors()
        yield Person(browser)


@pytest.mark.parametrize("kind", first_quick(list(HOSTILE), 2))
def test_words_of_a_robot_are_text(person: Person, services: StubServices, kind: str):
    words = HOSTILE[kind]
    page, many = person.page, (words * LONGEST)[:LONGEST]
    order = MissionOrder("m1", "r0", MissionKind.GO, 1, words[:60], FIRST, words[:60], because=words)
    report = MissionReport(order, MissionState.FAILED, 0.0, many)
    doing = Status(words[:60], many, 3, 40, Pose2(), False, covariance=(0.04, 0.0, 0.01, 0.001))
    status = AgentStatus(doing, 5, "r0", 1, mission=report, last_error=many, error_age=200.0)
    services.fleet = FleetStatus((RobotEntry("r0", True, 0.2, status, Pose2(0.0, 0.0, 0.3), 0),))
    eventually(lambda: page.run("return document.querySelectorAll('#robots button').length") == 1)
    page.run("document.querySelector('#robots button').click()")
    eventually(lambda: many in person.text("selected"))
    for width in (320, 1000):
        page.look(width, 700)
        harmless(page)


@pytest.mark.parametrize("kind", first_quick(list(HOSTILE), 2))
def test_names_and_reasons_of_other_people_are_text(browser: Browser, server: MapServer, kind: str):
    name = HOSTILE[kind][:64].strip()
    with Web(("127.0.0.1", 0), server) as served:
        page = (person := opened(browser, served.port)).page
        page.errors()
        server.annotate(Annotation(name, Place(FIRST), False, HOSTILE[kind], 1))
        server.annotate(Annotation(str(FIRST.map), Floor(FIRST, name), False, HOSTILE[kind], 2))
        listed = "return document.getElementById('places').textContent"
        eventually(lambda: name in page.run(listed) and f"floor {name}" in page.run(listed))
        for width in (320, 1280):
            page.look(width, 700)
            person.press("fit")
            for tab in page.run("return [...document.querySelectorAll('[role=tab]')].map(one => one.id)"):
                person.press(tab)
                harmless(page)
        # The name is found as it is written.
        person.press("tab-edit")
        person.fill("edit-nodes", name)
        assert page.run("return mapweave.selection.names") == [str(FIRST)], json.dumps(name)
