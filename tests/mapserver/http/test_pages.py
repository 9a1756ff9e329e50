"""The page and its files: all asked for at once, of the right types, and the map is ready for the viewer."""

from __future__ import annotations

import re
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from mapweave.mapserver.http.pages import STATIC, WORKERS
from mapweave.mapserver.http.web import Web
from tests.mapserver.stub_services import StubServices
from tests.waiting import eventually

KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}


def test_the_browser_asks_for_all_modules_at_once(served: Web) -> None:
    root = f"http://127.0.0.1:{served.port}"
    page = urlopen(f"{root}/", timeout=10).read().decode()
    named = re.findall(r'<link rel="modulepreload" href="static/(\w+\.js)">', page)
    scripts = {path.name for path in STATIC.glob("*.js")}
    assert set(named) == scripts - {*WORKERS} and len(named) > 20
    for path in STATIC.iterdir():
        with urlopen(f"{root}/static/{path.name}", timeout=10) as reply:
            assert reply.read() == path.read_bytes()
            kind = reply.headers["Content-Type"].partition(";")[0]
        expected = {
            ".js": "text/javascript",
            ".css": "text/css",
            ".svg": "image/svg+xml",
            ".html": "text/html",
        }
        assert kind == expected[path.suffix]
    for wrong in ("none.js", "..%2fweb.py", "page.js/x"):
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{root}/static/{wrong}", timeout=10)


def test_the_map_is_ready_when_the_viewer_comes(served: Web, services: StubServices) -> None:
    looked = []
    real = services.merged
    services.merged = lambda: (looked.append(1), real())[1]  # type: ignore[method-assign]
    urlopen(f"http://127.0.0.1:{served.port}/", timeout=10).read()
    eventually(lambda: bool(looked))
