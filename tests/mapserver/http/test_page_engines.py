"""The page in Firefox and WebKit: the map is drawn, a node is chosen on it, and a link is explained."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.mapserver.http.web import Web
from tests.mapserver.stub_services import StubServices, two_maps
from tests.other_browsers import Page, firefox, there_is_no_firefox, there_is_no_webkit, webkit
from tests.waiting import eventually

ENGINES = [
    pytest.param(firefox, marks=pytest.mark.skipif(there_is_no_firefox(), reason="needs firefox-esr")),
    pytest.param(
        webkit, marks=pytest.mark.skipif(there_is_no_webkit(), reason="needs webkit2gtk-driver and xvfb")
    ),
]
TEXT = "return document.getElementById('{}').textContent"
# Of the canvas, whether it shows anything but its ground.
DRAWN = """
const canvas = document.getElementById('canvas'), c = canvas.getContext('2d');
const bytes = c.getImageData(0, 0, canvas.width, canvas.height).data;
for (let k = 4; k < bytes.length; k += 4) if (bytes[k] !== bytes[0] || bytes[k + 1] !== bytes[1]) return true;
return false"""
PLACE = """
const m = mapweave.model, row = m.rowOf('r0.1.5'), box = mapweave.painter.canvas.getBoundingClientRect();
mapweave.viewport.show(m.x[row], m.y[row], 200);
const [u, w] = mapweave.viewport.toScreen(m.x[row], m.y[row]);
return [box.left + u, box.top + w]"""
WHY = """
const link = mapweave.model.links[0], m = mapweave.model;
const [a, b] = [m.edges.a[link], m.edges.b[link]].map(row => m.name(row));
document.getElementById('tab-why').click();
const form = document.getElementById('form');
form.a.value = a; form.b.value = b; form.requestSubmit();
return [a, b]"""


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_the_page_works_in_other_browsers(engine: Callable[[Path], AbstractContextManager[Page]], tmp_path):
    services = StubServices()
    services.fleet = FleetStatus((RobotEntry("r0", True),))
    with Web(("127.0.0.1", 0), services) as served, engine(tmp_path) as page:
        page.open(f"http://127.0.0.1:{served.port}/")
        page.run(
            "window.failed = []; addEventListener('error', event => failed.push(event.message)); return 0"
        )
        nodes = len(two_maps().poses)
        eventually(lambda: page.run("return window.mapweave?.model.order.length ?? 0") == nodes)
        eventually(lambda: page.run("return Boolean(mapweave.painter.bitmap)"))
        eventually(lambda: page.run(DRAWN))
        assert page.run("return document.getElementById('undrawn').hidden")
        eventually(lambda: page.run(TEXT.format("summary")) == "12 nodes")
        assert "r0" in page.run(TEXT.format("robots"))
        page.click(*page.run(PLACE))
        eventually(lambda: "Node r0.1.5" in page.run(TEXT.format("selected")))
        a, b = page.run(WHY)
        eventually(lambda: f"{a} and {b}" in page.run(TEXT.format("result")))
        assert page.run("return failed") == []
