"""The live view by real HTTP over loopback."""

import asyncio
import http.client
import json
import re
import socket
import sys
import threading
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import SettingsError
from mapweave.scenarios.live import LiveFilm
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.waiting import eventually


def frame(level: int) -> np.ndarray:
    return np.full((120, 160, 3), level, np.uint8)


def level(jpeg: bytes) -> float:
    return float(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).mean())


@pytest.fixture
def live():
    with LiveFilm(0, "twins <b>") as live:
        yield live


def connect(live: LiveFilm) -> http.client.HTTPConnection:
    return http.client.HTTPConnection(urlsplit(live.url).netloc, timeout=10)


def get(live: LiveFilm, path: str) -> tuple[int, str, bytes]:
    connection = connect(live)
    connection.request("GET", path)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, answer.headers["Content-Type"], content


def next_part(answer: http.client.HTTPResponse) -> bytes | None:
    """The next image of a stream; None at its end."""
    line = answer.readline()
    while line == b"\r\n":
        line = answer.readline()
    if line in (b"--frame--\r\n", b""):
        return None
    assert line == b"--frame\r\n"
    headers = dict(h.split(": ") for h in iter(lambda: answer.readline().decode().strip(), ""))
    assert headers["Content-Type"] == "image/jpeg"
    return answer.read(int(headers["Content-Length"]))


def watch(live: LiveFilm) -> http.client.HTTPResponse:
    connection = connect(live)
    connection.request("GET", "/stream")
    answer = connection.getresponse()
    assert answer.status == 200
    assert answer.headers["Content-Type"] == "multipart/x-mixed-replace; boundary=frame"
    return answer


def test_the_page_shows_the_stream_and_one_frame_can_be_had(live):
    assert live.url.startswith("http://127.0.0.1:")
    live.show(frame(10))
    live.show(frame(200))
    status, kind, page = get(live, "/")
    assert (status, kind) == (200, "text/html; charset=utf-8")
    assert b'<img id="view"' in page and b"twins" not in page
    assert json.loads(get(live, "/title")[2]) == {"title": "twins <b>"}
    assert b'view.src = "stream"' in get(live, "/static/live.js")[2]
    status, kind, jpeg = get(live, "/frame.jpg?1")
    assert (status, kind) == (200, "image/jpeg")
    assert level(jpeg) == pytest.approx(200, abs=3)
    assert get(live, "/other")[0] == 404


def test_several_viewers_get_the_frames(live):
    live.show(frame(50))
    viewers = [watch(live) for _ in range(3)]
    for viewer in viewers:
        assert level(next_part(viewer)) == pytest.approx(50, abs=3)
    live.show(frame(150))
    for viewer in viewers:
        assert level(next_part(viewer)) == pytest.approx(150, abs=3)
    live.close()
    for viewer in viewers:
        assert next_part(viewer) is None, "the stream ends when the trial is over"


def test_the_latest_frame_wins(live):
    live.show(frame(0))
    viewer = watch(live)
    next_part(viewer)
    for k in range(1, 101):
        live.show(frame(2 * k))
    seen = [level(next_part(viewer))]
    while seen[-1] < 197:
        seen.append(level(next_part(viewer)))
    assert len(seen) <= 3, "a viewer that was busy is not shown the past"


def test_a_viewer_that_takes_nothing_does_not_hold_up_the_trial(live):
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280, 3)).astype(np.uint8)
    address = urlsplit(live.url)
    with socket.create_connection((address.hostname, address.port)) as stuck:
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.sendall(b"GET /stream HTTP/1.0\r\n\r\n")
        live.show(noise)
        time.sleep(0.2)
        began = time.perf_counter()
        for _ in range(200):
            live.show(noise)
        assert time.perf_counter() - began < 10.0, "it would wait for ever"
        assert get(live, "/frame.jpg")[0] == 200


def test_viewers_that_go_away_leave_no_word_behind(live, capfd):
    live.show(frame(5))
    viewer = watch(live)
    next_part(viewer)
    viewer.close()
    for k in range(20):
        live.show(frame(k))
        time.sleep(0.01)
    live.close()
    live.close()
    assert capfd.readouterr() == ("", "")


def test_a_port_in_use_is_reported_in_one_line(live):
    port = urlsplit(live.url).port
    for bad, words in ((port, "the port is taken"), (70000, "must be 0-65535")):
        with pytest.raises(SettingsError) as refusal:
            LiveFilm(bad)
        assert f"cannot use port {bad}" in str(refusal.value)
        assert words in str(refusal.value)
        assert "\n" not in str(refusal.value)


def test_closing_frees_the_port_and_ends_the_threads():
    live = LiveFilm(0)
    live.show(frame(1))
    viewer = watch(live)
    next_part(viewer)
    live.close()
    assert next_part(viewer) is None
    with LiveFilm(urlsplit(live.url).port) as again:
        assert again.url == live.url
    eventually(lambda: not any(t.name == "live" for t in threading.enumerate()))


def test_waiting_for_a_frame_that_never_comes_ends(live):
    assert asyncio.run(live.next_frame(0, 0.05)) is None
    live.show(frame(9))
    number, jpeg = asyncio.run(live.next_frame(0, 5.0))
    assert number == 1
    assert level(jpeg) == pytest.approx(9, abs=3)
    assert asyncio.run(live.next_frame(number, 0.05)) is None


def test_pages_of_other_sites_cannot_watch(live, opened):
    live.show(frame(9))
    connection = opened(connect(live))
    connection.request("GET", "/frame.jpg", headers={"Host": "evil.example"})
    assert connection.getresponse().status == 403


def test_without_the_http_extra_its_name_is_printed(monkeypatch):
    for name in [
        name for name in sys.modules if name.startswith(("mapweave.mapserver.http", "uvicorn", "starlette"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.setitem(sys.modules, "starlette", None)
    with pytest.raises(SettingsError, match=re.escape("pip install 'mapweave[server]'")) as refusal:
        LiveFilm(0)
    assert "\n" not in str(refusal.value)


@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_a_browser_shows_the_frames_and_the_end(live, tmp_path_factory):
    size = "const i = document.querySelector('img'); return i && i.naturalWidth"
    with Browser(tmp_path_factory.mktemp("profile")) as page:
        live.show(frame(9))
        page.open(live.url)
        # A browser shows a part of a stream when the next one begins.
        eventually(lambda: live.show(frame(99)) or page.run(size) == 160)
        eventually(lambda: page.run("return document.title") == "twins <b>")
