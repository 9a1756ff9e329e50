"""Draws the page in a real browser: `page.png` with the recorded fleet, `edit.png` with a plan being laid.

A picture that is there stays, since a browser draws each a little differently.
`python -m docs.site.page_picture` draws other ones.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from docs.floor_plan import plan_of, to_pixels
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.server import MapServer
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.building import Building
from tests.browser import Browser, there_is_none
from tests.waiting import eventually, free_port

FLEET, EDIT = (Path(__file__).with_name(f"{name}.png") for name in ("page", "edit"))
ROOMS = (0, 2, 4, 6, 8)
"""With a pair in each: the four corners and the middle of the building."""
CLICKS = 2.0
"""How far a person clicks beside a place, px."""
SHARP = "return mapweave.painter.drawn?.scale === mapweave.viewport.scale && !mapweave.painter.waiting"
LIVE = "return document.getElementById('connection').textContent === 'live'"
MERGED = 240.0
"""Longest wait for the merge, s."""


@contextmanager
def page_of(building: Building, folder: Path) -> Iterator[Browser]:
    """The page of a server with the robots' maps."""
    store = SqliteStore(folder / "s0.sqlite")
    for robot in range(building.robots):
        log = list(building.log(robot))
        map_id = log[0][0]
        entries = [
            ReceivedChange.read(map_id, k, encode_change(Change(map_id, k, 0, body)))
            for k, (_, body) in enumerate(log, 1)
        ]
        store.apply(map_id, 7, entries, len(entries))
    store.close()
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
    eventually(lambda: page.run("return mapweave.planEditor.pane.image?.naturalWidth"))
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


def draw_fleet() -> None:
    """The page of `mapweave server --demo`, once its maps are merged."""
    http = free_port()
    command = [sys.executable, "-m", "mapweave", "server", "--demo", "--http", str(http)]
    server = subprocess.Popen([*command, "--listen", f"tcp/127.0.0.1:{free_port()}"])
    try:
        with tempfile.TemporaryDirectory() as folder, Browser(Path(folder)) as page:
            eventually(lambda: listens(http), MERGED)
            page.look(1280, 800)
            page.open(f"http://127.0.0.1:{http}/")
            # Two of the four maps that it shows at once are joined to a third.
            eventually(lambda: page.run("return window.mapweave?.model.components.length") == 2, MERGED)
            eventually(lambda: page.run("return mapweave.painter.robots.length") == 4)
            # Until the server has merged, the page shows all as it was last shown.
            eventually(lambda: page.run(LIVE), MERGED)
            eventually(lambda: page.run(SHARP))
            page.screenshot(FLEET)
    finally:
        server.terminate()
        server.wait()


def listens(port: int) -> bool:
    """Whether a program takes connections at a port of loopback."""
    try:
        with socket.create_connection(("127.0.0.1", port), 1.0):
            return True
    except OSError:
        return False


def draw_edit() -> None:
    """The page while a plan is laid under the map of three robots."""
    building = Building.draw(3, 48, seed=2)
    with tempfile.TemporaryDirectory() as folder, page_of(building, Path(folder)) as page:
        lay_plan(page, building, Path(folder) / "office.png")
        page.screenshot(EDIT)


def main(again: bool = True) -> None:
    """Draw.

    Args:
        again: also what is there already.
    """
    wanted = [
        (path, draw) for path, draw in ((FLEET, draw_fleet), (EDIT, draw_edit)) if again or not path.exists()
    ]
    if wanted and there_is_none():
        print("there is no Chromium: the pictures of the page stay as they are", file=sys.stderr)
        return
    for _, draw in wanted:
        draw()


if __name__ == "__main__":
    main()
