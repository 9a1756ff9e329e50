"""Draws the page in a real browser: `page.png` with the recorded fleet, `edit.png` with a plan being laid.

Each browser, and each set of fonts, draws a page a little differently. So a picture has in it what it shows:
the words on the page, where the robots are, and the files of which the page consists. It stays as long as
that is the same.
"""

import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from docs.floor_plan import looks_the_same, plan_of, to_pixels
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.http import pages
from mapweave.mapserver.http.last_shown import read_shown
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from mapweave.recorded_fleet.fleet import prepare, replayed_robots
from mapweave.recorded_fleet.recording import DEMO_PAGE
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.building import Building
from synthetic.maps import write_store
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.waiting import eventually

FLEET, EDIT = (Path(__file__).with_name(f"{name}.png") for name in ("page", "edit"))
ROOMS = (0, 2, 4, 6, 8)
"""With a pair in each: the four corners and the middle of the building."""
CLICKS = 2.0
"""How far a person clicks beside a place, px."""
STEPS = 10
"""That the recorded robots drive, of half a second."""
SHARP = "mapweave.painter.drawn?.scale === mapweave.viewport.scale && !mapweave.painter.waiting"
LIVE = "document.getElementById('connection').textContent === 'live'"
IMAGE_HAS_COME = (
    "performance.getEntriesByType('resource')"
    ".some(one => one.name.includes('plan-images/') && one.responseEnd)"
)
SHOWN = """
const { painter: { robots }, model } = mapweave, m = x => x.toFixed(1);
return { words: document.body.innerText.replace(/battery \\d+ %/g, ""), links: model.links.length,
  robots: robots.map(({ name, x, y, alive }) => [name, m(x), m(y), alive]),
  nodes: model.order.map(row => [model.name(row), m(model.x[row]), m(model.y[row])]) }
"""
"""Words that are seen, without batteries, which run down, and what the map has, to 0.1 m."""
STATIC = Path(pages.__file__).with_name("static")
CONTENT = "Content"
"""Of a picture: the name under which it has what it shows."""
MERGED = 240.0
"""Longest wait for the merge, s."""


@contextmanager
def page_of(building: Building, folder: Path) -> Iterator[Browser]:
    """The page of a server with the robots' maps."""
    logs = {}
    for robot in range(building.robots):
        log = list(building.log(robot))
        logs[log[0][0]] = [body for _, body in log]
    write_store(folder / "s0.sqlite", logs)
    hub = MemoryHub()
    with MapServer(MemoryBus(hub), Keys("docs"), folder / "s0.sqlite", "s0") as server:
        assert server.settle(MERGED), "the map is merged"
        with Web(("127.0.0.1", 0), server) as web, Browser(folder / "profile") as page:
            page.look(1280, 800)
            page.open(f"http://127.0.0.1:{web.port}/")
            eventually(lambda: page.run("return mapweave.model.links.length"))
            yield page


def lay_plan(page: Browser, building: Building, image_path: Path) -> None:
    """Choose the plan, and click the pairs."""
    image, plan_from_world = plan_of(building)
    cv2.imwrite(str(image_path), image)
    page.run("document.getElementById('tab-edit').click()")
    page.run(
        "const kind = document.getElementById('edit-kind'); kind.value = 'plan';"
        "kind.dispatchEvent(new Event('change'))"
    )
    page.type("#plan-file", str(image_path))
    eventually(lambda: page.run("return mapweave.planEditor.pane.image?.width"))
    eventually(lambda: page.run(f"return {IMAGE_HAS_COME}"))
    rng = np.random.default_rng(3)
    for k, room in enumerate(ROOMS, 1):
        robot, number = np.argwhere(building.rooms == room)[0]
        node = NodeId(f"r{robot}", 1, 2 * number)
        place = plan_from_world @ building.world_from(node)
        u, v = to_pixels(np.array([place.x, place.y]), len(image)) + rng.normal(0.0, CLICKS, 2)
        page.run(
            f"const e = mapweave.planEditor, m = mapweave.model, row = m.rowOf('{node}');"
            f"e.clickedPlan({u}, {v}); e.clickedMap(m.x[row], m.y[row])"
        )
        eventually(lambda k=k: page.run("return document.querySelectorAll('#plan-pairs li').length") == k)
    eventually(lambda: "rms" in page.run("return document.getElementById('plan-fit').textContent"))
    page.run("document.getElementById('fit').click()")
    page.type("#plan-because", "drawing of 2024")
    page.run("document.activeElement.blur()")


def draw_fleet(path: Path) -> None:
    """The page of `mapweave server --demo`, once its maps are merged; the robots stand still for it."""
    hub, keys = MemoryHub(), Keys("docs")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        prepare(folder, folder / "s0.sqlite", read_shown(DEMO_PAGE))
        server = stack.enter_context(MapServer(MemoryBus(hub), keys, folder / "s0.sqlite", "s0"))
        robots = replayed_robots(MemoryBus(hub), keys, "s0", folder)
        for robot in robots:
            stack.callback(robot.close)

        def step(seconds: float) -> None:
            for robot in robots:
                robot.step(seconds)

        for _ in range(STEPS):
            step(0.5)
        assert server.settle(MERGED), "the maps are merged"
        web = stack.enter_context(Web(("127.0.0.1", 0), server))
        page = stack.enter_context(Browser(folder / "profile"))
        page.look(1280, 800)
        page.open(f"http://127.0.0.1:{web.port}/")
        # Two of the four maps that it shows at once are joined to a third.
        for condition in (
            "window.mapweave?.model.components.length === 2",
            "mapweave.painter.robots.length === 4",
            "document.querySelectorAll('#robots .good').length === 4",
            LIVE,
            SHARP,
        ):
            # Meanwhile the robots report, so that they count as alive.
            eventually(lambda condition=condition: step(0.0) or page.run(f"return {condition}"))
        keep(page, path)


def draw_edit(path: Path) -> None:
    """The page while a plan is laid under the map of three robots."""
    building = Building.draw(3, 48, seed=2)
    with tempfile.TemporaryDirectory() as folder, page_of(building, Path(folder)) as page:
        lay_plan(page, building, Path(folder) / "office.png")
        eventually(lambda: page.run(f"return {SHARP}"))
        keep(page, path)


def keep(page: Browser, path: Path) -> None:
    """Take a picture of the page, unless there is one that shows the same."""
    shown = page.run(SHOWN)
    files = sorted(STATIC.iterdir())
    shown["files"] = [(one.name, hashlib.sha256(one.read_bytes()).hexdigest()) for one in files]
    content = hashlib.sha256(json.dumps(shown, sort_keys=True).encode()).hexdigest()
    if path.exists() and content_of(path) == content:
        return
    drawn = path.with_suffix(".drawn.png")
    page.screenshot(drawn)
    try:
        if not (path.exists() and content_of(path) and looks_the_same(drawn, path)):
            write(drawn, path, content)
    finally:
        drawn.unlink()


def write(drawn: Path, path: Path, content: str) -> None:
    """Write a picture with what it shows, as a digest."""
    said = PngInfo()
    said.add_text(CONTENT, content)
    with Image.open(drawn) as image:
        image.convert("RGB").save(path, pnginfo=said, optimize=True)


def content_of(path: Path) -> str:
    """The digest of what a picture shows; empty if none is in it."""
    with Image.open(path) as image:
        return str(image.info.get(CONTENT, ""))


def main() -> None:
    """Draw both."""
    if there_is_none():
        needed = " and ".join(PROGRAMS)
        print(f"page.png and edit.png stay as they are: drawing needs {needed}", file=sys.stderr)
        return
    for path, draw in ((FLEET, draw_fleet), (EDIT, draw_edit)):
        draw(path)


if __name__ == "__main__":
    main()
