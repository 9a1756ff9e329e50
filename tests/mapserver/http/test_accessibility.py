"""The page by the rules of axe-core, in Chromium: every panel, light and dark, on a desk and on a phone."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.annotation import Annotation, Place
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.logins import Logins
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.person import Person
from tests.waiting import eventually

AXE = next(Path(sys.prefix).glob("audit/lib/python*/site-packages/axe_playwright_python/axe.min.js"), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH"),
    pytest.mark.skipif(AXE is None, reason="needs axe-core, which `make slow` installs"),
]
VIOLATIONS = """
return axe.run(document, { resultTypes: ['violations'] }).then(({ violations }) =>
  violations.flatMap(({ id, nodes }) => nodes.map(node => `${id}: ${node.target}: ${node.failureSummary}`)))
"""
GOAL = NodeId("a", 1, 1)
READY = "return window.mapweave?.model.order.length > 0 && !mapweave.page.loading"


def violations(page: Browser) -> list[str]:
    """What axe-core objects to on the page as it is."""
    assert AXE is not None
    page.run(f"if (!window.axe) {{ {AXE.read_text(encoding='utf-8')} }}")
    return [str(one) for one in page.run(VIOLATIONS)]


@pytest.fixture
def page(server: MapServer, browser: Browser, monkeypatch: pytest.MonkeyPatch) -> Iterator[Browser]:
    """A map of two robots, one of which drives to a goal."""
    order = MissionOrder("m1", "r0", MissionKind.GO, 1, "page", GOAL, goal="hall")
    doing = Status("driving", "3 nodes further", 3, 40, Pose2(), False, covariance=(0.04, 0.0, 0.01, 0.001))
    status = AgentStatus(doing, 5, "r0", 1, mission=MissionReport(order, MissionState.RUNNING, 0.25))
    fleet = FleetStatus(
        (RobotEntry("r0", True, 0.2, status, Pose2(0.2, 0.1, 0.3), 0), RobotEntry("r1", False))
    )
    monkeypatch.setattr(server, "robots", lambda: fleet)
    server.annotate(Annotation("hall", Place(GOAL), False, "anna", 1, ""))
    with Web(("127.0.0.1", 0), server) as served:
        browser.look(1280, 800)
        browser.open(f"http://127.0.0.1:{served.port}/")
        eventually(lambda: browser.run(READY))
        yield browser


@pytest.mark.parametrize(
    ("scheme", "mobile"), [("light", False), ("dark", False), ("light", True), ("dark", True)]
)
def test_no_panel_of_the_page_violates_a_rule(page: Browser, scheme: str, mobile: bool):
    person = Person(page)
    page.look(390 if mobile else 1280, 800, scheme, mobile)
    found = violations(page)
    person.search(GOAL)
    person.shows(f"Node {GOAL}")
    found += violations(page)
    person.open("selected")
    person.shows("Robot r0")
    found += violations(page)
    for name in ("why", "events", "photo"):
        person.press(f"tab-{name}")
        eventually(lambda name=name: person.text("result") or name != "why")
        found += violations(page)
    person.press("tab-edit")
    kinds = page.run("return [...document.getElementById('edit-kind').options].map(one => one.value)")
    # The forms of all have the same colours, and one form on a phone.
    for kind in kinds if (scheme, mobile) == ("light", False) else kinds[:1]:
        person.fill("edit-kind", kind)
        found += violations(page)
    assert not found, "\n".join(found)


def test_what_violates_a_rule_is_found(page: Browser):
    page.run(
        "const summary = document.getElementById('summary'), image = new Image();"
        "image.src = 'static/icon.svg'; summary.after(image); summary.style.color = '#ccc'"
    )
    assert {one.partition(":")[0] for one in violations(page)} == {"color-contrast", "image-alt"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_login_violates_no_rule(server: MapServer, browser: Browser, tmp_path, scheme: str):
    logins = Logins(KeyFolder.create(tmp_path / "keys", "demo", Profile.LAB, [], "s0").path)
    with Web(("127.0.0.1", 0), server, logins=logins) as web:
        browser.look(1280, 800, scheme)
        browser.open(f"http://127.0.0.1:{web.port}/")
        eventually(lambda: browser.run("return !document.getElementById('login').hidden"))
        found = violations(browser)
        assert not found, "\n".join(found)
