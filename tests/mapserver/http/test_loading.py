"""The page while a map server loads: the map of before, no robots, and "ask again" to all else."""

from __future__ import annotations

import json
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.mapserver.http import live
from mapweave.mapserver.http.live import HELD
from mapweave.mapserver.http.live_map import LiveMap
from mapweave.mapserver.http.loading import LoadingServer, read_shown, write_shown
from mapweave.mapserver.http.web import Web
from mapweave.recorded_fleet.recording import DEMO_PAGE
from synthetic.recorded_fleet import page
from tests.mapserver.http.test_live import expected, less, same, viewer
from tests.mapserver.stub_services import StubServices, two_maps


def before() -> str:
    shown = LiveMap()
    shown.show(less(two_maps()), {}, {})
    return shown.message(0)


def half() -> set[str]:
    return {str(node) for node in less(two_maps()).graphs[0].nodes}


def answer(web: Web, path: str, body: bytes | None = None) -> tuple[int, dict]:
    try:
        with urlopen(Request(f"http://127.0.0.1:{web.port}{path}", body), timeout=10) as reply:
            return reply.status, json.load(reply)
    except HTTPError as error:
        return error.code, json.load(error)


def test_the_map_of_before_is_shown_until_the_server_has_merged_its_own() -> None:
    server, loading = StubServices(), LoadingServer()
    server.fleet = FleetStatus((RobotEntry("r0", True),))
    server.holds = {"summary": "12 nodes", "settled": False}
    with Web(("127.0.0.1", 0), loading, before=before()) as web, viewer(web) as person:
        assert person.until("map")["whole"] and set(person.nodes()) == half()
        assert (
            person.until("state")["server"] == {"summary": HELD, "loading": True}
            and not person.last["state"]["robots"]
        )
        # Also what could be answered with an empty list: it would mean that there is nothing.
        for path, body in (
            ("/robots/r0/explore", b""), ("/stop", b""), ("/robots", None), ("/history", None),
            ("/nodes/r0.1.1", None), ("/map", None), ("/missions", None),
        ):  # fmt: skip
            status, refused = answer(web, path, body)
            assert status == 503 and refused["retry_after"] == 1.0, path
        assert answer(web, "/status") == (200, {"summary": "loading", "loading": True, "settled": False})
        assert answer(web, "/annotations")[0] == answer(web, "/plans")[0] == 200
        assert web.shown() == "", "what is there no more would be kept for the next start"
        loading.take(server)
        with viewer(web) as other:
            assert other.until("map")["whole"] and set(other.nodes()) == half(), "maps lie apart until merged"
        assert web.shown() == "", "nor is what is not merged yet worth more than the map of before"
        server.holds = {"summary": "12 nodes", "settled": True}
        assert person.until("map")["whole"] and same(person.nodes(), expected(two_maps()))
        while not person.until("state")["robots"]:
            pass
        assert person.last["state"]["server"]["summary"] == "12 nodes"
        with viewer(web) as later:
            assert later.until("map")["whole"] and same(later.nodes(), expected(two_maps()))
        kept = json.loads(web.shown())
        assert kept["whole"] and len(kept["components"]) == len(two_maps().graphs)


def test_a_server_that_is_never_done_shows_its_own_map_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "LONGEST_HOLD", 0.1)
    server, loading = StubServices(), LoadingServer()
    server.holds = {"summary": "12 nodes", "settled": False}
    loading.take(server)
    with Web(("127.0.0.1", 0), loading, before=before()) as web, viewer(web) as person:
        person.until("map")
        assert person.until("map")["whole"] and same(person.nodes(), expected(two_maps()))


def test_without_a_map_of_before_the_page_says_that_the_server_loads() -> None:
    with Web(("127.0.0.1", 0), LoadingServer()) as web, viewer(web) as person:
        assert person.until("state")["server"]["summary"] == "loading"
        assert "map" not in person.last


def test_what_was_shown_is_kept_or_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "s0.sqlite.shown"
    assert read_shown(path) == "" and not caplog.records
    write_shown(path, before())
    assert read_shown(path) == before()
    write_shown(path, "")
    assert read_shown(path) == before()
    path.write_bytes(path.read_bytes()[:-9])
    assert read_shown(path) == "" and "is damaged" in caplog.text
    path.write_bytes(b"of another program")
    assert read_shown(path) == ""
    write_shown(tmp_path / "none" / "s0.sqlite.shown", before())
    assert "the next start shows no map" in caplog.text


def test_the_page_of_the_demo_is_that_of_its_recording() -> None:
    kept, made = json.loads(read_shown(DEMO_PAGE)), json.loads(page())
    assert kept["components"] == made["components"] and kept["nodes"]["count"] == made["nodes"]["count"] > 80
    assert kept["edges"]["count"] == made["edges"]["count"]
