"""A person at the page in a real browser, and the map of two robots that it shows."""

import json
from typing import Any

import numpy as np

from mapweave.hybridmap.annotation import Annotation
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.server import MapServer
from synthetic.maps import map_tours
from synthetic.world import room
from tests.browser import Browser
from tests.mapserver.test_corrections import A, B
from tests.waiting import eventually

AT = """
const m = mapweave.model, box = mapweave.painter.canvas.getBoundingClientRect(), row = m.rowOf('{}');
const [u, v] = mapweave.viewport.toScreen(m.x[row], m.y[row]);
return [box.left + u, box.top + v];
"""
FACTS = (
    "return [...document.querySelectorAll('#selected dt')]"
    ".map(dt => [dt, dt.nextSibling].map(c => c.textContent))"
)
AT_ROBOT = """
const box = mapweave.painter.canvas.getBoundingClientRect(), robot = mapweave.painter.robots[0];
const [u, v] = mapweave.viewport.toScreen(robot.x, robot.y);
return [box.left + u, box.top + v];
"""


def logs() -> dict[MapId, list[ChangeBody]]:
    """Two robots drive through one hall; the last view of one and the first of the other show the same."""
    world, rng = room(0, 0, 6, 5, 300, np.random.default_rng(1)), np.random.default_rng(3)
    walks = {
        A: [Pose2(2.5 - 0.6 * (2 - k), 2.5, 1.0 * k) for k in range(3)],
        B: [Pose2(2.7 + 0.6 * k, 2.4, 2.05 + 1.0 * k) for k in range(3)],
    }
    return map_tours(world, walks, rng, 0.01, 0.01)


class Person:
    """A person at the page."""

    def __init__(self, page: Browser) -> None:
        self.page = page

    def text(self, name: str) -> str:
        return str(self.page.run(f"return document.getElementById('{name}').textContent"))

    def press(self, name: str) -> None:
        self.page.run(f"document.getElementById('{name}').click()")

    def open(self, panel: str) -> None:
        """That of the first robot is `selected`."""
        if panel == "selected":
            self.page.run("document.querySelector('#robots button').click()")
        else:
            self.press(f"tab-{panel}")

    def stop(self) -> None:
        """By the button of the robot that is selected."""
        buttons = "[...document.querySelectorAll('#selected button')]"
        self.page.run(f"{buttons}.find(one => one.textContent === 'Stop').click()")

    def search(self, words: object) -> None:
        self.fill("query", words)
        self.page.run("document.getElementById('search').requestSubmit()")

    def facts(self) -> dict[str, str]:
        """What the panel says of what is selected, by name."""
        return dict(self.page.run(FACTS))

    def shows(self, heading: str) -> None:
        """Wait until this is selected."""
        shown = "return document.querySelector('#selected h2')?.textContent"
        eventually(lambda: self.page.run(shown) == heading)

    def fill(self, name: str, value: object) -> None:
        self.page.run(
            f"const one = document.getElementById('{name}'); one.value = {json.dumps(str(value))};"
            "for (const kind of ['input', 'change']) one.dispatchEvent(new Event(kind, { bubbles: true }))"
        )

    def mouse(self, *points: tuple[float, float], modifiers: int = 0) -> None:
        """Press at the first point, and let go at the last one."""
        kinds = ["mousePressed", *["mouseMoved"] * (len(points) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, [*points, points[-1]], strict=True):
            self.page.devtools(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1,
                modifiers=modifiers,
            )  # fmt: skip

    def key(self, key: str, text: str = "") -> None:
        for kind in ("keyDown", "keyUp"):
            self.page.devtools(
                "Input.dispatchKeyEvent", type=kind, key=key, **({"text": text} if kind == "keyDown" else {})
            )

    def at_robot(self) -> tuple[float, float]:
        """Where the first robot is drawn."""
        x, y = self.page.run(AT_ROBOT)
        return x, y

    def at(self, node: NodeId) -> tuple[float, float]:
        x, y = self.page.run(AT.format(node))
        return x, y

    def edit(self, kind: str, because: str, **fields: object) -> str:
        """Fill in a form and have it checked; returns what the server says."""
        self.fill("edit-kind", kind)
        for name, value in fields.items():
            self.fill(f"edit-{kind}-{name}", value)
        self.fill("edit-because", because)
        self.press("edit-check")
        eventually(lambda: self.text("edit-answer") not in ("", "Asking ..."))
        return self.text("edit-answer")

    def apply(self) -> str:
        self.press("edit-apply")
        eventually(lambda: "only checked" not in self.text("edit-answer") != "Asking ...")
        return self.text("edit-answer")

    def take_back(self, server: MapServer) -> None:
        """The newest correction."""
        listed = "return document.getElementById('corrections').children.length"
        before = count(server)
        eventually(lambda: self.page.run(listed) == before)
        self.page.run("document.querySelector('#corrections li button').click()")
        eventually(lambda: self.page.run(listed) == before + 1)


def opened(browser: Browser, port: int) -> Person:
    browser.look(1280, 800)
    browser.open(f"http://127.0.0.1:{port}/")
    eventually(lambda: browser.run("return window.mapweave ? mapweave.model.order.length : 0"))
    person = Person(browser)
    person.press("tab-edit")
    return person


def count(server: MapServer) -> int:
    return len(server.constraints().made) + len(server.annotations().made)


def last(server: MapServer) -> Any:
    return server.constraints().made[-1].about


def annotation(server: MapServer) -> Annotation:
    return server.annotations().made[-1]
