"""Manual constraints by Python, HTTP and shell, over real connections, and after the server starts again."""

import http.client
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapweave import Fleet, connection
from mapweave import fleet as fleet_module
from mapweave.cli import main
from mapweave.commands import map_constraint
from mapweave.exit_status import NO, USAGE
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.constraint_subject import Linked, RetiredArea, RetiredNodes, RetiredWindow
from mapweave.hybridmap.errors import InvalidValue, NotConnected, Refused
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.server import MapServer
from mapweave.storage.map_file import MapFile
from mapweave.wire.keys import Keys
from mapweave.wire.messages import encode
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import LOG_ID, entries_of, map_tours, write_store
from synthetic.world import room
from tests.waiting import eventually
from tests.wire.fleets import ZenohFleet

A, B = MapId("a", 1), MapId("b", 1)
LAST, FIRST = NodeId("a", 1, 5), NodeId("b", 1, 1)
TRUE = Pose2(2.5, 2.5, 2.0).inverse() @ Pose2(2.7, 2.4, 2.05)


def logs(stops: int = 3) -> dict[MapId, list[ChangeBody]]:
    """Two robots turn on the spot in one hall; one pair of views shows the same, too little to join them."""
    world, rng = room(0, 0, 6, 5, 300, np.random.default_rng(1)), np.random.default_rng(3)
    tours = {
        map_id: [Pose2(x, y, turn + 1.0 * k) for k in range(stops)]
        for map_id, (x, y, turn) in {A: (2.5, 2.5, 0.0), B: (2.7, 2.4, 2.05)}.items()
    }
    return map_tours(world, tours, rng, 0.01, 0.01)


class Asking:
    """A person with Python, a browser's connection and a shell."""

    def __init__(self, fleet: Fleet, server: MapServer, port: int, endpoint: str) -> None:
        self.fleet, self.server, self.port = fleet, server, port
        self.at = ["--fleet", "demo", "--connect", endpoint, "--by", "carl"]

    def http(self, method: str, body: object = None) -> tuple[int, dict[str, Any]]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        data = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        connection.request(method, "/constraints", data, {"Content-Type": "application/json"})
        reply = connection.getresponse()
        return reply.status, json.loads(reply.read())

    def merged(self) -> MapFile:
        """Once the server has merged with all constraints."""
        assert self.server.settle(60)
        return self.fleet.map()


def answers(fleet: Fleet) -> bool:
    """Whether the server can be reached: a declaration needs a moment to get about."""
    try:
        fleet.constraints()
    except NotConnected:
        return False
    return True


@contextmanager
def serving(path: Path) -> Iterator[Asking]:
    router = ZenohFleet()
    try:
        with (
            MapServer(router.join(), Keys("demo"), path, "s0") as server,
            Web(("127.0.0.1", 0), server, 60.0) as web,
            Fleet(router.endpoints[0], by="anna") as fleet,
        ):
            assert server.settle(60)
            eventually(lambda: answers(fleet))
            yield Asking(fleet, server, web.port, router.endpoints[0])
    finally:
        router.close()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_store(tmp_path / "s0.sqlite", logs())


@pytest.fixture
def merging(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """While it is not set, servers do not merge."""
    merging, merged = threading.Event(), Merger.merged
    merging.set()

    def in_its_time(self: Merger, use: Any = None) -> Any:
        assert merging.wait(60)
        return merged(self, use)

    monkeypatch.setattr(Merger, "merged", in_its_time)
    return merging


def components(content: MapFile) -> int:
    return len({number for number, _ in content.poses.values()})


def test_corrections_by_python_http_and_shell_outlast_the_server(path: Path, capfd):
    with serving(path) as asking:
        fleet = asking.fleet
        before = asking.merged()
        assert components(before) == 2
        with pytest.raises(InvalidValue, match=r"do not show one place: \d+ features? match"):
            fleet.link("a.1.1", "b.1.3")
        said = fleet.link(str(FIRST), str(LAST), because="both see the red door", check=True)
        assert said.startswith("only checked, nothing is changed: ") and not fleet.constraints()
        fleet.link(str(FIRST), str(LAST), because="both see the red door")
        joined = asking.merged()
        assert components(joined) == 1
        poses = {node: pose.mean for node, (_, pose) in joined.poses.items()}
        assert (poses[LAST].inverse() @ poses[FIRST]).distance(TRUE) < 0.05
        (made,) = fleet.constraints()
        assert (made.who, made.because) == ("anna", "both see the red door")
        assert isinstance(made.about, Linked) and made.about.evidence

        status, answer = asking.http("POST", {"retire": ["b.1.5"], "by": "bob", "because": "repainted"})
        assert status == 200 and "1 node of b.1" in answer["said"], answer
        assert asking.merged().poses.keys() == before.poses.keys() - {NodeId("b", 1, 5)}
        status, answer = asking.http("POST", {"retire": ["b.1.5"]})
        assert status == 400 and "retired already: node b.1.5 is retired by bob" in answer["error"]
        _, listed = asking.http("GET")
        assert [(one["number"], one["in_force"], one["who"]) for one in listed["constraints"]] == [
            (1, True, "anna"), (2, True, "bob")
        ]  # fmt: skip
        assert listed["constraints"][1]["about"] == {"kind": "nodes", "nodes": ["b.1.5"]}

    # Meanwhile b maps on.
    store = SqliteStore(path)
    more = logs(4)[B]
    later = [change for change in more if change not in more[:3]][:1] + more[-1:]
    store.apply(B, LOG_ID, entries_of(B, later, 6), 7)
    store.close()
    with serving(path) as asking:
        content = asking.merged()
        assert components(content) == 1 and NodeId("b", 1, 7) in content.poses
        assert NodeId("b", 1, 5) not in content.poses
        capfd.readouterr()
        assert main(["map", "undo", *asking.at]) == 0
        lines = capfd.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines] == ["1", "2"] and "repainted" in lines[1]
        assert main(["map", "undo", "2", "--because", "it was not", *asking.at]) == 0
        assert "node b.1.5 is in use again, by carl" in capfd.readouterr().out
        assert main(["map", "link", str(LAST), str(FIRST), "--undo", *asking.at]) == 0
        content = asking.merged()
        assert components(content) == 2 and NodeId("b", 1, 5) in content.poses
        history = [event.words for event in content.history]
        assert not content.retired and any("are no longer one map" in words for words in history)
        area = Area(NodeId("a", 1, 1), ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))
        assert "map a.1 has no node left" in asking.fleet.retire(area=area)
        assert {node.map for node in asking.merged().poses} == {B}
        with pytest.raises(Refused, match=r'constraint 2 was taken back already by carl on .*: "it was not'):
            asking.fleet.undo(2)
        status, answer = asking.http("POST", {"undo": 1})
        assert status == 400 and "constraint 1 was taken back already by carl" in answer["error"]
        asking.fleet.undo(asking.fleet.constraints()[4])
        assert asking.merged().poses.keys() == content.poses.keys()
        kinds = [type(one.about) for one in asking.fleet.constraints()]
        assert kinds == [Linked, RetiredNodes, RetiredNodes, Linked, RetiredArea, RetiredArea]


def test_the_shell_asks_as_python_does(path: Path, monkeypatch, capfd):
    """Each of its questions had a connection of its own, other words, and a limit of its own."""
    reached, reach = [], connection.reach

    def counted(*arguments: Any) -> ZenohBus:
        reached.append(arguments)
        return reach(*arguments)

    with serving(path) as asking:
        for module in (connection, fleet_module):
            monkeypatch.setattr(module, "reach", counted)
        python = asking.fleet
        refused: dict[tuple[str, ...], Callable[[], object]] = {
            ("undo", "9"): lambda: python.undo(9),
            ("retire", "z.1"): lambda: python.retire("z.1"),
            ("unmerge", "a.1", "b.1"): lambda: python.unlink("a.1", "b.1"),
            ("link", "a.1.1", "nowhere"): lambda: python.link("a.1.1", "nowhere"),
            ("explain", "a.1.1", "z.1.1"): lambda: python.explain("a.1.1", "z.1.1"),
            ("route", "a.1.1", "z.1.1"): lambda: python.route("a.1.1", "z.1.1"),
        }
        for words, by_python in refused.items():
            with pytest.raises(Refused) as why:
                by_python()
            reached.clear()
            capfd.readouterr()
            assert main(["map", *words, *asking.at[:4]]) == NO
            assert capfd.readouterr().err == f"mapweave: {why.value}\n"
            assert len(reached) == 1, words
        reached.clear()
        assert main(["map", "retire", "b.1.5", *asking.at]) == 0 and len(reached) == 1


def test_python_hears_of_every_server_what_it_keeps_and_refuses(path: Path, tmp_path):
    """Of several the first to answer was all that it heard of."""
    other = write_store(tmp_path / "s1.sqlite", {B: logs()[B]})
    router = ZenohFleet()
    try:
        with (
            MapServer(router.join(), Keys("demo"), path, "s0") as first,
            MapServer(router.join(), Keys("demo"), other, "s1") as second,
            Fleet(router.endpoints[0], by="anna") as fleet,
        ):
            assert first.settle(60) and second.settle(60)
            eventually(lambda: len(fleet.servers()) == 2)
            said = fleet.retire("a.1").splitlines()
            assert sorted(line.partition(" ")[0] for line in said) == ["another", "map"], said
            assert any(line.startswith("another map server refused: there is no map a.1") for line in said)
    finally:
        router.close()


def test_of_two_links_before_a_merge_the_second_must_fit_the_first(
    path: Path, merging: threading.Event, capfd
):
    """Both were taken, and either of them contradicted the map for ever."""
    with serving(path) as asking:
        fleet = asking.fleet
        merging.clear()
        fleet.link(str(FIRST), str(LAST))
        between = Pose2(2.5, 2.5, 0.0).inverse() @ Pose2(2.7, 2.4, 2.05 + 1.0)  # of a.1.1 and b.1.3
        off = between @ Pose2(1.5, 0.0)
        words = f"standard deviations, at most 4.0 pass. The link by hand of {LAST} and {FIRST} joins them: "
        with pytest.raises(InvalidValue, match=words):
            fleet.link("a.1.1", "b.1.3", pose=off, because="it is one room")
        given = [off.x, off.y, float(np.degrees(off.heading))]
        body = {"link": ["a.1.1", "b.1.3"], "pose": given, "because": "it is one room"}
        status, answer = asking.http("POST", body)
        assert status == 400 and re.search(words, answer["error"]), answer
        capfd.readouterr()
        pose = f"--pose={','.join(map(str, given))}"
        command = ["map", "link", "a.1.1", "b.1.3", pose, "--because", "it is one room", *asking.at]
        assert main(command) == NO
        assert re.search(words, capfd.readouterr().err)
        fleet.link("a.1.1", "b.1.3", pose=between, because="it is one room")
        assert len(fleet.constraints()) == 2
        # What is taken back before a merge is in the way of nothing.
        fleet.undo(2)
        fleet.undo(1)
        fleet.link("a.1.1", "b.1.3", pose=off, because="it is one room")
        merging.set()
        content = asking.merged()
        poses = {node: pose.mean for node, (_, pose) in content.poses.items()}
        a, b = NodeId("a", 1, 1), NodeId("b", 1, 3)
        assert (poses[a].inverse() @ poses[b]).distance(off) < 0.01


def test_who_waits_for_a_merge_hears_what_for(path: Path, merging: threading.Event, monkeypatch, capfd):
    monkeypatch.setattr(map_constraint, "PATIENT", 0.05)
    with serving(path) as asking:
        capfd.readouterr()
        merging.clear()
        threading.Timer(0.5, merging.set).start()
        assert main(["map", "retire", "b.1.5", *asking.at]) == 0
        out, err = capfd.readouterr()
        assert out.startswith("node b.1.5 is retired by carl") and out.count("\n") == 1
        assert err.count("waiting until the server has merged with it ...\n") == 1


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({}, "give one of link, unmerge, retire"),
        ({"link": ["a.1.1", "a.1.1"]}, "a.1.1 twice"),
        ({"link": ["a.1.1"]}, "the body is no constraint"),
        ({"link": ["a.1.1", "b.1.1"], "pose": [0, 0, 0], "unmerge": ["a.1", "b.1"]}, "give one of"),
        ({"unmerge": ["a.1", "b.1"]}, "no link joins a.1 and b.1"),
        ({"retire": ["z.1"]}, "there is no map z.1"),
        ({"area": {"anchor": "a.1.1", "corners": [[0, 0], [1, 1]]}}, "3 to 64 corners"),
        ({"window": {"map": "a.1", "begin": 5, "end": 4}}, "ends after it begins"),
        ({"window": {"map": "a.1", "begin": "noon"}}, "'noon' is no time"),
        ({"window": {"map": "a.1"}}, 'a time window begins or ends: give "begin", "end" or both'),
        ({"window": {"map": "a.1", "begin": "", "end": ""}}, '{"retire": ["a.1"]} retires the whole map'),
        ({"window": {"map": "a.1", "end": 0}}, "map a.1 until 1970-01-01 00:00:00 UTC: no node lies in it"),
        ({"undo": 1}, "there is no constraint 1"),
        ({"retired": ["a.1"]}, "`retired`: there is no such field; send link, unmerge"),
        ({"link": "a.1.1"}, '`link`: give a list, not text; for example ["r0.1.17", "r1.1.5"]'),
        ({"link": ["a.1.1", 5]}, "`link[1]`: give text, not a whole number; for example ["),
        ({"retire": "a.1"}, "`retire`: give a list, not text; for example ["),
        ({"undo": "1"}, "`undo`: give true or false, or a whole number, not text; for example 3"),
        ({"undo": 1.5}, "`undo`: give true or false, or a whole number, not a number with decimals"),
        ({"retire": ["a.1"], "check": "yes"}, "`check`: give true or false, not text; for example true"),
        ({"window": {"map": 1}}, "`window.map`: give text, not a whole number; for example {"),
        ({"area": {"anchor": "a.1.1"}}, "`area.corners`: this field is missing; for example {"),
        (b"5", "the body is no constraint"),
        (b'{"link": ["\xff", "a.1.1"]}', "the body is no constraint"),
    ],
)
def test_a_request_that_is_wrong_says_why(small: Asking, body: object, words: str):
    status, answer = small.http("POST", body)
    assert status == 400 and words in answer["error"], answer
    assert "Expected `" not in answer["error"] and "$" not in answer["error"]
    assert small.http("GET") == (200, {"constraints": []})


def test_places_stand_for_nodes_and_areas_in_corrections(path: Path):
    with serving(path) as asking:
        fleet = asking.fleet
        fleet.annotate("place", "door", node=str(LAST))
        fleet.annotate("place", "gate", node=str(FIRST))
        around = Area(NodeId("b", 1, 5), ((-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)))
        corners = [list(corner) for corner in around.corners]
        fleet.annotate("place", "corner", area={"anchor": "b.1.5", "corners": corners})

        def posted(**body: object) -> str:
            status, answer = asking.http("POST", {**body, "check": True})
            return str(answer["said" if status == 200 else "error"])

        # The same by name as by id, of Python and of HTTP.
        linked = fleet.link(str(FIRST), str(LAST), check=True)
        assert linked == fleet.link("gate", " door ", check=True) == posted(link=["gate", "door"], by="anna")
        fleet.link("gate", "door")
        asking.merged()
        assert "1 link is undone" in fleet.unlink("door", "gate", check=True)
        assert "1 link is undone" in posted(unmerge=["door", "gate"])
        assert main(["map", "unmerge", "door", "gate", "--check", *asking.at]) == 0
        assert main(["map", "link", "gate", "door", "--undo", "--check", *asking.at]) == 0
        assert f"node {LAST} is retired" in fleet.retire("door", check=True)
        nodes = f"nodes {LAST} and b.1.5 are retired"
        assert nodes in fleet.retire("b.1.5", "door", check=True) and nodes in posted(
            retire=["door", "b.1.5"]
        )
        # An area is retired as a whole, and the same name takes it back.
        for words in (fleet.retire("corner", check=True), posted(retire=["corner"])):
            assert "the area of 4 corners at b.1.5 is retired" in words
        assert f"corners at {LAST} is retired" in posted(area={"anchor": "door", "corners": corners})
        for body in ({"retire": ["corner"]}, {"retire": ["gate"]}):
            assert asking.http("POST", body)[0] == 200
            asking.merged()
            assert asking.http("POST", {**body, "undo": True})[0] == 200
            asking.merged()
        with pytest.raises(InvalidValue, match="place corner is an area: give it alone"):
            fleet.retire("corner", "door")
        for refused in (lambda: fleet.retire("dor"), lambda: fleet.link("dor", "gate")):
            with pytest.raises(InvalidValue, match=r"'dor' is no place of this map \(is it door\?\): give"):
                refused()
        assert "'dor' is no place of this map" in posted(area={"anchor": "dor", "corners": corners})


def test_a_node_in_the_place_of_a_retired_one_is_named_with_the_reason(path: Path, capfd):
    """Only lists and explanations named it."""
    with serving(path) as asking:
        asking.fleet.place("door", str(LAST))
        asking.fleet.retire("door")
        asking.merged()
        why = f"door: {LAST} takes no part (node {LAST} is retired by anna on "
        assert why in asking.fleet.pin("door", check=True)
        body = {"name": "a.1", "body": {"kind": "floor", "node": "door", "label": "first"}, "check": True}
        connection = http.client.HTTPConnection("127.0.0.1", asking.port, timeout=60)
        connection.request("POST", "/annotations", json.dumps(body), {"Content-Type": "application/json"})
        assert why in json.loads(connection.getresponse().read())["said"]
        capfd.readouterr()
        for command in ("map pin door", "avoid door --radius 2", "floor first door"):
            assert main([*command.split(), "--check", *asking.at]) == 0, command
            assert why in "".join(capfd.readouterr()), command
        assert main(["map", "pin", "door", *asking.at]) == 0
        assert main(["map", "pin", "door", "--undo", *asking.at]) == 0


def test_a_closure_of_an_edge_that_is_none_is_refused_and_others_say_how_much_they_close(
    small: Asking, tmp_path, capfd
):
    with pytest.raises(InvalidValue, match=r"^no edge joins a\.1\.1 and b\.1\.5 \(a\.1\.1 has edges to node"):
        small.fleet.annotate("closure", "nowhere", edge=["a.1.1", "b.1.5"])
    assert not small.fleet.annotations().made
    # Likewise in a file.
    path = tmp_path / "both.mapweave"
    small.fleet.save(path)
    capfd.readouterr()
    assert main(["close", "a.1.1", "b.1.5", "--map", str(path)]) == NO
    assert capfd.readouterr().err.startswith("mapweave: no edge joins a.1.1 and b.1.5 (")
    assert main(["close", "a.1.1", "a.1.3", "--map", str(path)]) == 0
    assert re.search(r"; it closes \d+ ways? of robots$", capfd.readouterr().out.strip())


def test_an_outline_that_crosses_itself_is_refused_by_every_way_to_give_one(small: Asking, tmp_path, capfd):
    """A bow tie was taken, and closed two corners of the floor that was meant."""
    words = [(0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)]
    line = (
        "the outline of the area crosses itself (its side from corner 1 to 2 and that from corner 3 to 4): "
    )
    line += "give the corners in order around it"
    bow_tie, corners = Area(FIRST, tuple(words)), [list(corner) for corner in words]
    fleet, area = small.fleet, {"anchor": str(FIRST), "corners": corners}
    for kind, more in (("place", {}), ("closure", {}), ("preference", {"factor": 2.0})):
        for field in ({"area": area}, {"corners": corners}):
            with pytest.raises(Refused, match=f"^{re.escape(line)}$"):
                fleet.annotate(kind, "hall", **field, **more)
    with pytest.raises(InvalidValue, match=f"^{re.escape(line)}$"):
        fleet.retire(area=bow_tie)
    assert small.http("POST", {"area": area}) == (400, {"error": line})
    # As a client that does not check sends it.
    raw = encode(ConstraintRequest(ManualConstraint(RetiredArea(bow_tie), False, "anna", 1)))
    unchecked = raw.replace(b"\xa5holds\xc2", b"\xa5holds\xc3")
    assert unchecked != raw
    (reply,) = fleet._bus.ask(fleet._keys.any_constrain(), unchecked, 10.0)
    assert line in reply.error
    path = tmp_path / "both.mapweave"
    fleet.save(path)
    before = path.read_bytes()
    capfd.readouterr()
    at = [f"{x:g},{y:g}" for x, y in words]
    for where in (small.at, ["--map", str(path)]):
        for command in (["place", "add", "hall"], ["close"], ["avoid"]):
            assert main([*command, "--corners", *at, *where]) == USAGE
            assert capfd.readouterr().err == f"mapweave: --corners: {line}\n"
        assert main(["map", "retire", "--area", str(FIRST), " ".join(at), *where]) == USAGE
        assert capfd.readouterr().err == f"mapweave: {line}\n"
    assert not fleet.annotations().made and not fleet.constraints() and path.read_bytes() == before
    # The same corners in order, the first of them again at the end.
    square = [corners[0], corners[2], corners[1], corners[3], corners[0]]
    assert "4.0 m²" in fleet.annotate("place", "hall", area={**area, "corners": square})
    fleet.withdraw("place", "hall")


@pytest.mark.parametrize(
    ("begin", "end", "words"),
    [
        (
            "2026-03-01T12:05", "2026-03-01T13:00+01:00",
            "its end, 2026-03-01 12:00:00 UTC, is before its beginning, 2026-03-01 12:05:00 UTC",
        ),
        (
            1_772_366_700_000_000_009, 1_772_366_700_000_000_005,
            "its end, 2026-03-01 12:05:00 UTC (1772366700000000005 ns), is before its beginning, "
            "2026-03-01 12:05:00 UTC (1772366700000000009 ns)",
        ),
        (5, -5, "between 0 and 9223372036854775807 ns since 1970"),
        (-(10**30), 5, "between 0 and 9223372036854775807 ns since 1970"),
    ],
)  # fmt: skip
def test_a_time_window_that_ends_before_it_begins_is_refused_with_times_that_people_read(
    small: Asking, begin: str | int, end: str | int, words: str
):
    status, answer = small.http("POST", {"window": {"map": "a.1", "begin": begin, "end": end}, "check": True})
    assert status == 400 and answer["error"].count("\n") == 0
    assert words in answer["error"]
    with pytest.raises(InvalidValue, match=re.escape(words)):
        small.fleet.retire("a.1", begin=begin, end=end)


def test_a_time_of_zero_is_a_time(small: Asking):
    with pytest.raises(InvalidValue, match="until 1970-01-01 00:00:00 UTC: no node lies in it"):
        small.fleet.retire("a.1", end=0)


def test_what_is_taken_back_says_what_another_correction_still_excludes(path: Path, tmp_path, capfd):
    with serving(path) as asking:
        fleet = asking.fleet
        fleet.annotate("closure", "shut", edge=["a.1.1", "a.1.3"])
        fleet.annotate("closure", "other", edge=["b.1.1", "b.1.3"])
        said = fleet.retire("a.1.1", check=True)
        assert said.endswith("; without effect as long as it holds: closure shut")
        fleet.retire("b.1.5", because="a mirror")
        asking.merged()
        status, answer = asking.http("POST", {"retire": ["b.1"], "by": "bob", "because": "another day"})
        assert status == 200, answer
        asking.merged()
        path = tmp_path / "both.mapweave"
        fleet.save(path)
        still = 'but node b.1.5 stays out of use: map b.1 is retired by bob on .*: "another day"$'
        assert re.search(f"^node b.1.5: taken back by anna on .*, {still}", fleet.undo(1))
        capfd.readouterr()
        assert main(["map", "undo", "1", "--by", "anna", "--map", str(path)]) == 0
        assert re.search(
            f"^node b.1.5: taken back by anna on .*, {still}", capfd.readouterr().out, re.MULTILINE
        )
        # A window of all times, as servers took it before, can be taken back.
        fleet.undo(2)
        asking.merged()
        fleet.retire("a.1", begin=0)
        assert isinstance(fleet.constraints()[-1].about, RetiredWindow)
        status, answer = asking.http("POST", {"window": {"map": "a.1"}, "undo": True})
        assert status == 200 and "map a.1 is in use again" in answer["said"]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Asking]:
    with serving(write_store(tmp_path_factory.mktemp("small") / "s0.sqlite", logs())) as asking:
        yield asking
