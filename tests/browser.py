"""A real browser for tests: Chromium without a window, driven by the W3C WebDriver protocol."""

from __future__ import annotations

import base64
import shutil
import subprocess
from pathlib import Path
from typing import Any

from tests.waiting import eventually, free_port
from tests.webdriver import ask

PROGRAMS = ("chromium", "chromedriver")
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=420,800",
)  # fmt: skip


def there_is_none() -> bool:
    """Whether this machine has no browser to test with."""
    return any(shutil.which(name) is None for name in PROGRAMS)


class Browser:
    """One page at a time. Use it as a context."""

    def __init__(self, folder: Path, *flags: str) -> None:
        """Start it with a profile of its own in a folder."""
        self._port = free_port()
        self._driver = subprocess.Popen(
            [str(shutil.which("chromedriver")), f"--port={self._port}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            eventually(self._ready)
            options = {
                "binary": shutil.which("chromium"),
                "args": [*FLAGS, *flags, f"--user-data-dir={folder}"],
            }
            wanted = {
                "alwaysMatch": {"browserName": "chrome", "goog:chromeOptions": options,
                 "goog:loggingPrefs": {"browser": "ALL"}},
            }  # fmt: skip
            self._session = f"/session/{self._ask('POST', '/session', {'capabilities': wanted})['sessionId']}"
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._ask("DELETE", self._session)
        finally:
            self._end()

    def open(self, address: str) -> None:
        """Go to a page."""
        self._ask("POST", f"{self._session}/url", {"url": address})

    def type(self, selector: str, text: str) -> None:
        """Type into the field that a CSS selector finds; into one for files, a path."""
        result = self._ask("POST", f"{self._session}/element", {"using": "css selector", "value": selector})
        self._ask("POST", f"{self._session}/element/{result[ELEMENT]}/value", {"text": text})

    def run(self, script: str) -> Any:
        """What a function body in JavaScript returns."""
        return self._ask("POST", f"{self._session}/execute/sync", {"script": script, "args": []})

    def devtools(self, command: str, **parameters: object) -> Any:
        """What a command of the Chrome DevTools protocol returns."""
        body = {"cmd": command, "params": parameters}
        return self._ask("POST", f"{self._session}/goog/cdp/execute", body)

    def look(self, width: int, height: int, scheme: str = "light", mobile: bool = False) -> None:
        """Show pages in a window of some size, px, light or dark, or on a phone."""
        self.devtools(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if mobile else 1, mobile=mobile,
        )  # fmt: skip
        self.devtools("Emulation.setTouchEmulationEnabled", enabled=mobile)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.devtools("Emulation.setEmulatedMedia", features=features)

    def screenshot(self, path: Path) -> None:
        """Write what is seen into a PNG file."""
        path.write_bytes(base64.b64decode(self._ask("GET", f"{self._session}/screenshot")))

    def errors(self) -> list[str]:
        """What the page has complained of since the last call."""
        entries = self._ask("POST", f"{self._session}/se/log", {"type": "browser"})
        return [entry["message"] for entry in entries if entry["level"] == "SEVERE"]

    def _ready(self) -> bool:
        try:
            return bool(self._ask("GET", "/status")["ready"])
        except OSError:
            return False

    def _ask(self, method: str, path: str, body: object = None) -> Any:
        return ask(self._port, method, path, body)

    def _end(self) -> None:
        self._driver.terminate()
        self._driver.wait(30)
