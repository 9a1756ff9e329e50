"""The page while a map server loads: all as it was last shown, and "ask again" to all else."""

import json
from dataclasses import replace
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import scipy.sparse as sparse

from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.json_values import json_values
from mapweave.mapserver.http.last_shown import NOTHING, LastShown, read_shown, write_shown
from mapweave.mapserver.http.live import NOT_MERGED, NOT_THERE
from mapweave.mapserver.http.live_map import LiveMap
from mapweave.mapserver.http.loading import LoadingServer
from mapweave.mapserver.http.web import Web
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.recorded_fleet.recording import DEMO_PAGE
from synthetic.recorded_fleet import TOURS, page
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.test_live import expected, less, same, viewer
from tests.mapserver.stub_services import StubServices, two_maps
from tests.waiting import eventually

JOINED = MapEvent(10**18, MapEventKind.JOINED, "r0.1 and r1.1 are one map now")


def message(merged: MergedMap) -> str:
    shown = LiveMap()
    shown.show(merged, {}, {})
    return shown.message(0)


def at(name: str, pose: Pose2) -> RobotEntry:
    status = AgentStatus(Status("driving", "", 3, 40, Pose2(), False), 5, name, 1, battery=0.5)
    return RobotEntry(name, True, 0.2, status, pose, 0)


def before() -> LastShown:
    robots = json_values(FleetStatus((at("r0", Pose2(5.5, 0.0, 0.1)), at("r1", Pose2(6.0, 0.0, 0.0)))))
    return LastShown(message(less(two_maps())), tuple(robots["robots"]), (JOINED,))


def half() -> set[str]:
    return {str(node) for node in less(two_maps()).graphs[0].nodes}


def answer(web: Web, path: str, body: bytes | None = None) -> tuple[int, dict]:
    try:
        with urlopen(Request(f"http://127.0.0.1:{web.port}{path}", body), timeout=10) as reply:
            return reply.status, json.load(reply)
    except HTTPError as error:
        return error.code, json.load(error)


def test_all_is_shown_as_before_until_the_server_has_merged():
    server, loading = StubServices(), LoadingServer()
    server.holds = {"summary": "12 nodes", "settled": False, "merged": False}
    with Web(("127.0.0.1", 0), loading, before=before()) as web, viewer(web) as person:
        assert person.until("map")["whole"] and set(person.nodes()) == half()
        assert [event["words"] for event in person.until("events")["history"]] == [JOINED.words]
        state = person.until("state")
        assert state["server"] == {"summary": NOT_THERE, "loading": True}
        assert [(one["robot"], one["alive"], one["before"]) for one in state["robots"]] == [
            ("r0", False, True), ("r1", False, True),
        ]  # fmt: skip
        assert state["robots"][0]["merged_from_robot"] == [5.5, 0.0, 0.1]
        # Also what could be answered with an empty list: it would mean that there is nothing.
        for path, body in (
            ("/robots/r0/explore", b""), ("/stop", b""), ("/robots", None), ("/history", None),
            ("/nodes/r0.1.1", None), ("/map", None), ("/missions", None),
        ):  # fmt: skip
            status, refused = answer(web, path, body)
            assert status == 503 and refused["retry_after"] == 1.0, path
        assert answer(web, "/status") == (200, {"summary": "loading", "loading": True, "settled": False})
        assert answer(web, "/annotations")[0] == answer(web, "/plans")[0] == 200
        assert web.shown() == NOTHING, "what is there no more would be kept for the next start"
        server.events = (JOINED,)
        server.fleet = FleetStatus((at("r0", two_maps().pose(NodeId("r0", 1, 1)) @ Pose2(0.3, 0.0, 0.0)),))
        loading.take(server)
        with viewer(web) as other:
            assert other.until("map")["whole"] and set(other.nodes()) == half(), "maps lie apart until merged"
            while other.until("state")["robots"][0]["alive"] is False:
                pass
            heard, unheard = other.last["state"]["robots"]
            assert other.last["state"]["server"] == {"summary": NOT_MERGED, "loading": True}
            assert (unheard["robot"], unheard["before"]) == ("r1", True) and "before" not in heard
            (x, y, heading, component, _) = other.nodes()["r0.1.1"]
            there = Pose2(x, y, heading) @ Pose2(0.3, 0.0, 0.0)
            assert np.allclose(heard["merged_from_robot"], there.vector, atol=2e-3), "on the map shown"
            assert heard["component"] == component
        assert web.shown() == NOTHING, "nor is what is not merged yet worth more than the map of before"
        server.holds = {"summary": "12 nodes", "settled": False, "merged": True}
        assert person.until("map")["whole"] and same(person.nodes(), expected(two_maps()))
        heard, unheard = person.until("state")["robots"]
        assert (unheard["robot"], unheard["before"]) == ("r1", True) and "before" not in heard
        assert np.allclose(unheard["merged_from_robot"], [1.0, 0.0, 0.0], atol=2e-3), "on the server's map"
        while len(person.until("state")["robots"]) != 1:
            pass
        assert person.last["state"]["server"] == {"summary": "12 nodes", "settled": False}
        server.events = (JOINED, replace(JOINED, words="they came apart"))
        assert [event["words"] for event in person.until("events")["history"]] == ["they came apart"]
        with viewer(web) as later:
            assert later.until("map")["whole"] and same(later.nodes(), expected(two_maps()))
        kept = web.shown()
        assert json.loads(kept.map)["whole"] and len(kept.parts) == len(two_maps().graphs)
        assert kept.history == server.events and [robot["robot"] for robot in kept.robots] == ["r0"]


def test_a_robot_that_no_common_node_places_is_shown_without_a_place():
    elsewhere = FleetStatus((at("r1", Pose2(1.0, 1.0, 0.0)),))
    only_r1 = two_maps().graphs[0].nodes[-1]
    assert only_r1.agent == "r1"
    merged = two_maps()
    graph = merged.graphs[0]
    kept = [row for row, node in enumerate(graph.nodes) if node.agent == "r1"]
    nodes = tuple(graph.nodes[row] for row in kept)
    alone = PoseGraph(nodes[0], nodes, graph.means[kept], sparse.identity(3 * len(kept), format="csc"))
    (_, entry) = before().fleet(elsewhere, replace(merged, graphs=(alone,)))
    assert entry["robot"] == "r1" and entry["alive"]
    assert (entry["merged_from_robot"], entry["component"]) == (None, -1)


@pytest.mark.parametrize("there", [False, True])
def test_what_a_server_waits_for_is_said(there: bool):
    shown, loading = before() if there else NOTHING, LoadingServer()
    words = "waiting: no database"
    loading.wait(words)
    with Web(("127.0.0.1", 0), loading, before=shown) as web, viewer(web) as person:
        said = {"summary": words, "loading": True, "settled": False, "event": words}
        assert answer(web, "/status") == (200, said)
        assert person.until("state")["server"]["summary"].startswith(words)
        loading.wait("")
        eventually(lambda: person.until("state")["server"]["summary"] == (NOT_THERE if shown else "loading"))


def test_without_a_map_of_before_the_page_says_that_the_server_loads():
    with Web(("127.0.0.1", 0), LoadingServer()) as web, viewer(web) as person:
        assert person.until("state")["server"]["summary"] == "loading"
        assert "map" not in person.last


@pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
def test_the_page_lists_a_map_of_before_without_robots(browser: Browser):
    """The panel beside the map was empty until the server had merged."""
    with Web(("127.0.0.1", 0), LoadingServer(), before=replace(before(), robots=())) as web:
        browser.open(f"http://127.0.0.1:{web.port}/")
        eventually(lambda: NOT_THERE in browser.run("return document.getElementById('connection').innerText"))
        listed = "return document.getElementById('components').checkVisibility({ visibilityProperty: true })"
        assert browser.run(listed)


def test_what_was_shown_is_kept_or_left_out(tmp_path, caplog):
    path = tmp_path / "s0.sqlite.shown"
    assert read_shown(path) == NOTHING and not caplog.records
    write_shown(path, before())
    assert read_shown(path) == before()
    write_shown(path, NOTHING)
    assert read_shown(path) == before()
    path.write_bytes(path.read_bytes()[:-9])
    assert read_shown(path) == NOTHING and "is damaged" in caplog.text
    path.write_bytes(b"of another program")
    assert read_shown(path) == NOTHING
    write_shown(tmp_path / "none" / "s0.sqlite.shown", before())
    assert "the next start shows no map" in caplog.text


def test_the_page_of_the_demo_is_that_of_its_recording():
    kept, made = read_shown(DEMO_PAGE), page()
    shown, fresh = json.loads(kept.map), json.loads(made.map)
    assert shown["components"] == fresh["components"]
    assert shown["nodes"]["count"] == fresh["nodes"]["count"] > 80
    assert shown["edges"]["count"] == fresh["edges"]["count"]
    assert kept.parts == made.parts
    assert [event.words for event in kept.history] == [event.words for event in made.history] != []
    names = [robot["robot"] for robot in kept.robots]
    assert names == [robot["robot"] for robot in made.robots] == sorted(TOURS)
    assert all(robot["merged_from_robot"] for robot in kept.robots)
