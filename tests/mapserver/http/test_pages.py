"""The page and its files: all asked for at once, of the right types, and the map is ready for the viewer."""

import re
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from mapweave.mapserver.http.login import READ_ONLY, Person, why_not
from mapweave.mapserver.http.pages import STATIC, WORKERS
from mapweave.mapserver.http.web import Web
from mapweave.wire.credentials import Role
from tests.mapserver.stub_services import StubServices
from tests.waiting import eventually


def test_the_browser_asks_for_all_modules_at_once(served: Web):
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


def test_the_page_names_no_options_of_commands():
    """A person at the page has none: what may not be done there is said in words."""
    files = (path for path in STATIC.iterdir() if path.suffix in {".html", ".js"})
    said = {"map file": READ_ONLY, **{path.name: path.read_text(encoding="utf-8") for path in files}}
    for name in ("", "anna"):
        for role in Role:
            said[f"{name} {role}"] = why_not(Person(name, role), "give")
    for where, words in said.items():
        assert not re.search(r"(^|[\s`(])--[a-z]", words), where
    assert "until the server has keys" in said[f" {Role.VIEWER}"]


def luminance(colour: str) -> float:
    """Relative luminance, by WCAG 2.2."""
    channels = [int(one, 16) / 255 for one in re.findall("..", colour)]
    linear = [one / 12.92 if one <= 0.04045 else ((one + 0.055) / 1.055) ** 2.4 for one in channels]
    return sum(share * one for share, one in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
def test_words_have_the_contrast_that_people_with_weak_eyes_need(theme: int):
    """Level AA of WCAG 2.2, 4.5 to 1: "parted" in the timeline had 4.4, and a doubt about a plan 4.1."""
    css = (STATIC / "page.css").read_text(encoding="utf-8").partition("* {")[0]
    block = css.split("prefers-color-scheme: dark")[theme].replace("#fff;", "#ffffff;")
    colours = {name: luminance(colour) for name, colour in re.findall(r"--(\w+): #(\w{6})", block)}
    for words in ("ink", "soft", "accent", "good", "warn", "bad"):
        for behind in ("ground", "panel"):
            dark, light = sorted((colours[words], colours[behind]))
            assert (light + 0.05) / (dark + 0.05) >= 4.5, f"{words} on {behind}"


def test_the_map_is_ready_when_the_viewer_comes(served: Web, services: StubServices):
    looked = []
    real = services.merged
    services.merged = lambda: (looked.append(1), real())[1]  # type: ignore[method-assign]
    urlopen(f"http://127.0.0.1:{served.port}/", timeout=10).read()
    eventually(lambda: bool(looked))
