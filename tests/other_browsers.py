"""Firefox and WebKit for tests, where they are installed; see tests/browser.py for Chromium.

Firefox is driven by WebDriver BiDi, which needs no driver beside it, WebKitGTK by its own driver, on a
display of its own. Debian's packages: firefox-esr; webkit2gtk-driver and xvfb.
"""

import itertools
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from tests.waiting import eventually, free_port
from tests.webdriver import ask

SIZE = 1280, 800
MINI_BROWSERS = "/usr/lib", "*/webkit2gtk-4.*/MiniBrowser"


def _click(x: float, y: float) -> list[dict[str, Any]]:
    """Actions of a mouse, alike in both protocols."""
    steps: list[dict[str, Any]] = [
        {"type": "pointerMove", "x": round(x), "y": round(y)},
        {"type": "pointerDown", "button": 0},
        {"type": "pointerUp", "button": 0},
    ]
    return [{"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": steps}]


class Page(Protocol):
    """What tests ask of a browser."""

    def open(self, address: str) -> None:
        """Go to a page."""

    def run(self, script: str) -> Any:
        """What a function body in JavaScript returns."""

    def click(self, x: float, y: float) -> None:
        """Press the mouse's button at a place of the page, px."""


class _Firefox:
    def __init__(self, connection: ClientConnection) -> None:
        self._connection, self._numbers = connection, itertools.count(1)
        self._ask("session.new", capabilities={})
        self._context = self._ask("browsingContext.getTree")["contexts"][0]["context"]
        viewport = dict(zip(("width", "height"), SIZE, strict=True))
        self._ask("browsingContext.setViewport", context=self._context, viewport=viewport)

    def open(self, address: str) -> None:
        self._ask("browsingContext.navigate", context=self._context, url=address, wait="complete")

    def run(self, script: str) -> Any:
        words = f"JSON.stringify((() => {{ {script} }})() ?? null)"
        result = self._ask(
            "script.evaluate", expression=words, target={"context": self._context}, awaitPromise=False
        )
        assert result["type"] == "success", result
        return json.loads(result["result"]["value"])

    def click(self, x: float, y: float) -> None:
        self._ask("input.performActions", context=self._context, actions=_click(x, y))

    def _ask(self, method: str, **parameters: object) -> Any:
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (reply := json.loads(self._connection.recv(timeout=60))).get("id") != number:
            pass
        assert reply["type"] == "success", reply
        return reply["result"]


@contextmanager
def firefox(folder: Path) -> Iterator[Page]:
    """Firefox without a window, with a profile of its own in a folder."""
    port, opened, stack = free_port(), list[ClientConnection](), ExitStack()
    command = [
        "firefox-esr", "--headless", "--no-remote", "--profile", folder, f"--remote-debugging-port={port}",
    ]  # fmt: skip
    browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def ready() -> bool:
        try:
            address = f"ws://127.0.0.1:{port}/session"
            opened.append(stack.enter_context(connect(address, max_size=2**26, proxy=None)))
        except (OSError, WebSocketException):
            return False
        return True

    try:
        eventually(ready, 90)
        yield _Firefox(opened[0])
    finally:
        stack.close()
        browser.terminate()
        browser.wait(30)


class _WebKit:
    def __init__(self, port: int, binary: Path) -> None:
        self._port = port
        options = {"webkitgtk:browserOptions": {"binary": str(binary), "args": ["--automation"]}}
        session = ask(port, "POST", "/session", {"capabilities": {"alwaysMatch": options}})
        self._session = f"/session/{session['sessionId']}"

    def open(self, address: str) -> None:
        self._ask("POST", "/url", {"url": address})

    def run(self, script: str) -> Any:
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def click(self, x: float, y: float) -> None:
        self._ask("POST", "/actions", {"actions": _click(x, y)})

    def close(self) -> None:
        self._ask("DELETE", "")

    def _ask(self, method: str, path: str, body: object = None) -> Any:
        return ask(self._port, method, self._session + path, body)


@contextmanager
def webkit(folder: Path) -> Iterator[Page]:
    """WebKitGTK's small browser; writes into a folder."""
    binary = next(Path(MINI_BROWSERS[0]).glob(MINI_BROWSERS[1]))
    read, write = os.pipe()
    # The server chooses a free display, and names it when it is there.
    command = [
        "Xvfb", "-displayfd", str(write), "-screen", "0", f"{SIZE[0]}x{SIZE[1]}x24", "-nolisten", "tcp",
    ]  # fmt: skip
    display = subprocess.Popen(
        command, pass_fds=[write], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(write)
    port = free_port()
    with os.fdopen(read) as named:
        environment = os.environ | {
            "DISPLAY": f":{named.readline().strip()}", "HOME": str(folder), "LIBGL_ALWAYS_SOFTWARE": "1",
            "WEBKIT_DISABLE_SANDBOX_THIS_IS_DANGEROUS": "1",
        }  # fmt: skip
    driver = subprocess.Popen(
        ["WebKitWebDriver", f"--port={port}"], env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    opened = list[_WebKit]()

    def ready() -> bool:
        try:
            opened.append(_WebKit(port, binary))
        except OSError:
            return False
        return True

    try:
        eventually(ready, 60)
        yield opened[0]
    finally:
        for page in opened:
            page.close()
        for process in (driver, display):
            process.terminate()
            process.wait(30)


def there_is_no_firefox() -> bool:
    """Whether Firefox is not installed."""
    return shutil.which("firefox-esr") is None


def there_is_no_webkit() -> bool:
    """Whether WebKitGTK, its driver or Xvfb is not installed."""
    programs = any(shutil.which(name) is None for name in ("WebKitWebDriver", "Xvfb"))
    return programs or next(Path(MINI_BROWSERS[0]).glob(MINI_BROWSERS[1]), None) is None
