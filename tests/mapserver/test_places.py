"""Named places by way of the map server: made, used wherever a node is, kept, and taken back."""

import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import quote

import numpy as np
import pytest

from mapweave.cli import main
from mapweave.exit_status import NO, USAGE
from mapweave.fleet import Fleet
from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.hybridmap.annotation import Annotation, Annotations, Floor, Place
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import MapEventKind
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, ResolveRequest
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.base_map import BaseMap
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.map_files import merged_of
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.routes import Router
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.map_file import MapFile, read_map_file, unpack_map_file, write_map_file
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode, encode_view
from synthetic.maps import looking_around, map_tours, write_store
from synthetic.world import room, take_view
from tests.mapserver.house import KEYS, STANDING, House, MappedRoom, ask
from tests.waiting import eventually

THERE = NodeId("r0", 1, 3)


def test_a_place_stands_wherever_a_node_may_stand_and_outlasts_the_server(house: House):
    person, (link, _) = house.person, house.robot()
    said = person.annotate("place", "kitchen", because="the sink", node=str(THERE))
    assert said == f'place kitchen is node {THERE}, by anna: "the sink"'
    at = house.server._worker.current().merged.pose(THERE)
    person.annotate("place", "hall", node=f"{at.x:.2f},{at.y:.2f}", radius=3.0)
    with pytest.raises(InvalidValue, match="that is known already"):
        person.annotate("place", "kitchen", node=str(THERE))
    with pytest.raises(InvalidValue, match=r"there is no map r9\.1"):
        person.annotate("place", "cellar", node="r9.1.1")
    with pytest.raises(InvalidValue, match="place 'home'"):
        person.annotate("place", "home", node=str(THERE))
    for _ in range(2):
        assert person.go("r0", "kitchen").order.node == THERE
        assert house.entry("r0").place == "kitchen", "next to it, within the hall"
        answer = decode(
            house.bus().ask(KEYS.relocalize("s0"), encode_view(house.mapped.view(THERE)), 20.0)[0].payload,
            RelocalizeAnswer,
        )
        assert (answer.certainty, answer.candidates[0].place) == (Certainty.FOUND, "kitchen")
        house.restart_server()
        eventually(lambda: house.entry("r0").status is not None or link.report(STANDING, 3))
    with pytest.raises(
        InvalidValue, match=r"'kitchn' is no place of this map \(is it kitchen\?\): give a node"
    ):
        person.go("r0", "kitchn")
    for name, rest in (("kitchn", r" \(is it kitchen\?\)$"), ("cellar", "; there are: hall, kitchen$")):
        with pytest.raises(InvalidValue, match=f"there is no place {name}{rest}"):
            person.withdraw("place", name)
    with pytest.raises(InvalidValue, match=r"there is no closure kitchen$"):
        person.withdraw("closure", "kitchen")
    person.withdraw("place", "kitchen")
    with pytest.raises(InvalidValue, match="goal 'kitchen' is no place of this map: give a node"):
        person.go("r0", "kitchen")
    with pytest.raises(InvalidValue, match="there is no place kitchen"):
        person.withdraw("place", "kitchen")
    events = [event.words for event in house.server.history() if event.kind is MapEventKind.ANNOTATED]
    assert [words.partition(" is ")[0] for words in events] == [
        "place kitchen",
        "place hall",
        "place kitchen",
    ]
    made = person.annotations().made
    assert unpack_map_file(person.map_bytes()).annotations == made and len(made) == 3


def test_a_letter_with_an_accent_is_the_same_however_it_is_written(house: House, tmp_path, capsys):
    """As one character, as most keyboards do, or as a letter with an accent behind it."""
    one, two = "caf\u00e9", "cafe\u0301"
    person, path = house.person, tmp_path / "room.mapweave"
    house.robot()
    person.save(path)
    assert person.annotate("place", two, node=str(THERE)).startswith(f"place {one} is node")
    for name in (one, two):
        assert person.go("r0", name).order.node == THERE
        assert person.retire(name, check=True).startswith("only checked")
        with pytest.raises(InvalidValue, match="that is known already"):
            person.annotate("place", name, node=str(THERE))
    person.withdraw("place", two)
    assert not person.annotations().in_force(Place)
    with pytest.raises(InvalidValue):
        person.go("r0", one)
    # Likewise in a file.
    assert main(["place", "add", two, str(THERE), "--map", str(path)]) == 0
    assert main(["place", "add", one, str(THERE), "--map", str(path)]) == NO
    assert main(["place", "remove", two, "--map", str(path)]) == 0
    assert {entry.name for entry in read_map_file(path).annotations} == {one}
    capsys.readouterr()
    assert Annotations((Annotation(two, Place(THERE), False, "anna", 1),)).last("place", one) is not None


def test_a_long_reason_is_no_error_of_what_is_kept(house: House):
    """What an entry says and what the one before has said is more than the answer holds."""
    for note in ("a", "b"):
        said = house.person.annotate(
            "portal", 64 * "x", 300 * "y", a="r0.1.1", b="r0.1.3", means="door", note=120 * note
        )
        assert said.startswith("portal xxx")
    assert len(house.person.annotations().made) == 2


def test_an_annotation_is_tried_before_it_is_kept(house: House):
    """On the page and over HTTP it could be; by shell and in Python a mistake had to be made first."""
    person = house.person
    said = person.annotate("place", "kitchen", node=str(THERE), check=True)
    assert said == f"only checked, nothing is changed: place kitchen is node {THERE}, by anna"
    assert person.annotate("closure", "paint", node=str(THERE), radius=1.0, check=True).endswith(" of robots")
    with pytest.raises(InvalidValue, match=r"there is no map r9\.1"):
        person.annotate("place", "cellar", node="r9.1.1", check=True)
    assert person.annotations().made == ()
    person.annotate("place", "kitchen", node=str(THERE))
    assert "place kitchen is withdrawn" in person.withdraw("place", "kitchen", check=True)
    assert person.annotations().last("place", "kitchen") is not None


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["place", "add", "sink", "r0.1.5"], "place sink is node r0.1.5"),
        (["place", "remove", "kitchen"], "place kitchen is withdrawn"),
        (["close", "kitchen"], "closure kitchen is an area"),
        (["prefer", "r0.1.3", "--radius", "1"], "preference r0.1.3 is an area"),
        (["floor", "ground", "r0.1.3"], "floor r0.1 is on floor ground"),
        (["map", "portal", "add", "gate", "r0.1.3", "r0.1.5", "--kind", "door"], "portal gate is a door"),
        (["map", "pin", "r0.1.3"], "pin r0.1.3 is"),
    ],
)
def test_an_annotation_of_a_file_is_tried_before_it_is_kept(
    fetched: MapFile, tmp_path, capsys, command: list[str], words: str
):
    path = tmp_path / "room.mapweave"
    write_map_file(path, replace(fetched, annotations=record("kitchen", Place(THERE)).made))
    before = path.read_bytes()
    assert main([*command, "--map", str(path), "--check"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"only checked, nothing is changed: {words}") and out.count("\n") == 1
    assert path.read_bytes() == before


def test_places_over_http(house: House):
    with Web(("127.0.0.1", 0), house.server) as web:
        body = {"name": "Küche", "body": {"kind": "place", "node": "r0.1.3"}, "because": "tea"}
        status, posted = ask(web, "POST", "/annotations?by=bob", body)
        assert status == 200 and posted["annotation"]["who"] == "bob"
        corners = [[-2, -2], [3, -2], [3, 3], [-2, 3]]
        hall = {"name": "hall", "body": {"kind": "place", "corners": corners}}
        assert ask(web, "POST", "/annotations", hall)[0] == 200
        nowhere = {"name": "hall", "body": {**hall["body"], "near": 5}}
        status, refused = ask(web, "POST", "/annotations", nowhere)
        assert status == 400 and "`near`" in refused["error"]
        gone = {"name": "hall", "body": {"kind": "place"}, "removed": True}
        assert "withdrawn" in ask(web, "POST", "/annotations", gone)[1]["said"]
        entries = ask(web, "GET", "/annotations")[1]["annotations"]
        assert [(one["name"], one["removed"], one["in_force"]) for one in entries] == [
            ("Küche", False, True), ("hall", False, False), ("hall", True, False),
        ]  # fmt: skip
        assert entries[0]["body"] == {"kind": "place", "node": "r0.1.3", "area": None}
        route = ask(web, "GET", f"/route?a={quote('Küche')}&b=r0.1.9")[1]
        assert route["found"] and (route["start"], route["goal"]) == ("r0.1.3", "r0.1.9")
        for wrong, reason in [
            (b"{", "Input data was truncated"),
            (b'{"name": "x", "body": {"kind": "hologram"}}', "an annotation has a kind: place"),
            (b'{"name": "x", "body": {"kind": "place", "colour": 1}}', "a place has no colour"),
            (b'{"name": "x", "body": {"kind": "place", "node": 5}}', "`node`: give a node as text, for exam"),
            (b'{"name": "x", "body": {"kind": "place", "node": "50,50"}}', "nothing is mapped within 2 m"),
            (
                b'{"name": "x", "body": {"kind": "place", "corners": [[0, 0], [2, 2], [2, 0], [0, 2]]}}',
                "crosses itself",
            ),
            (
                b'{"name": "x", "body": {"kind": "place", "corners": [[1e308, 0], [1e308, 1], [-1e308, 0]]}}',
                "corners are at most 1e+06 m from the origin of the map",
            ),
            (
                b'{"name": "x", "body": {"kind": "place", "node": "r0.1.3", "radius": 1e4}}',
                "radius 10000: give metres, more than 0 and less than 10000",
            ),
            (
                b'{"name": "x", "body": {"kind": "place", "node": "1e308,0"}}',
                "nothing is mapped within 2 m of 1e+308,0: the nearest node is r0.1.1, 1e+308 m away at ",
            ),
            (b'{"name": "r0.1.1", "body": {"kind": "place", "node": "r0.1.3"}}', "looks like a node"),
            (b'{"name": "x", "body": {"kind": "place", "radius": 1}}', "`node`: give a node as text"),
            (
                b'{"name": "x", "body": {"kind": "place", "radius": 1, "node": ["r0"]}}',
                "`node`: give a node as text",
            ),
            (b'{"name": 5, "body": {"kind": "place"}}', "`name`: give text, not a whole number; for example"),
            (b'{"name": "x"}', "`body`: this field is missing; for example {"),
            (b'{"name": "x", "body": [], "why": "y"}', "`body`: give an object, not a list; for example {"),
            (b'{"name": "x", "body": {}, "why": "y"}', "`why`: there is no such field"),
            (b"[]", "give an object, not a list; send {"),
            (
                b'{"name": "x", "body": {"kind": "place", "node": "r0.1.3", "radius": "1"}}',
                "`radius`: give a number, not text; for example 1.5",
            ),
            (
                b'{"name": "x", "body": {"kind": "place", "corners": [[0, 0], [1, "0"], [1, 1]]}}',
                "`corners[1][1]`: give a number, not text; for example [[",
            ),
            (
                b'{"name": "x", "body": {"kind": "closure", "edge": ["r0.1.1"]}}',
                '`edge`: give a list of 2 elements, not 1; for example ["r0.1.17", "r0.1.19"]',
            ),
            (
                b'{"name": "r0.1", "body": {"kind": "floor", "node": "r0.1.3", "label": ""}}',
                "`label`: give text of at least 1 character; for example",
            ),
            (
                b'{"name": "x", "body": {"kind": "portal", "a": "r0.1.1", "b": "r0.1.3", "means": "rope"}}',
                "`means`: 'rope' is none of the words that it may be; for example \"lift\", ",
            ),
            (b'{"name": "x", "body": {"a": ' + 9999 * b"[", "recursion"),
        ]:
            status, answer = ask(web, "POST", "/annotations", wrong)
            assert status == 400 and reason in answer["error"], answer
            assert "Expected `" not in answer["error"] and "$" not in answer["error"]


@pytest.fixture(scope="module")
def fetched(mapped_room: Callable[[], MappedRoom]) -> MapFile:
    house = House(mapped_room())
    content = unpack_map_file(house.person.map_bytes())
    house.close()
    return content


@pytest.fixture(scope="module")
def merged(fetched: MapFile) -> MergedMap:
    return merged_of(fetched)


def test_very_many_floors_of_a_part_are_as_many_as_a_message_holds(merged: MergedMap):
    maps = [MapId("r0", number) for number in range(5)]
    labels = Annotations(tuple(
        Annotation(str(which), Floor(NodeId(*which, 1), f"{which.epoch}" * 64), False, "anna", 1)
        for which in maps
    ))  # fmt: skip
    graphs = (SimpleNamespace(maps=maps),)
    places = PlaceResolver(Router(merged), labels)
    places.router = SimpleNamespace(merged=SimpleNamespace(graphs=graphs))  # type: ignore[assignment]
    entry = RobotEntry("r0", True, floor=places.floor_of(0))
    assert decode(encode(FleetStatus((entry,))), FleetStatus).robots == (entry,)


def record(name: str, place: Place) -> Annotations:
    return Annotations((Annotation(name, place, False, "anna", 1),))


def test_a_place_whose_node_is_superseded_is_the_nearest_active_node(merged: MergedMap):
    away = {node: merged.pose(node).distance(merged.pose(THERE)) for node in merged.poses if node != THERE}
    nearest = min(away, key=away.__getitem__)
    older = replace(merged, superseded={THERE: Superseded(max(away, key=away.__getitem__), 9, 0.1, 0.1)})
    found = PlaceResolver(Router(older), record("kitchen", Place(THERE))).resolve("kitchen")
    assert found.node == nearest and "r0.1.3 is superseded" in found.note


def test_a_place_whose_node_is_in_no_map_any_more_says_why(merged: MergedMap):
    kitchen = record("kitchen", Place(NodeId("r9", 1, 1)))
    with pytest.raises(InvalidValue, match=r"place kitchen is at r9\.1\.1, which is not in the merged map"):
        PlaceResolver(Router(merged), kitchen).resolve("kitchen")
    # All of its map is retired: no node of it is left to take its place.
    constraint = ManualConstraint(RetiredMap(THERE.map), True, "bob", 0, "the old flat")
    none = replace(merged, poses={}, components=(), graphs=(), constraints=ManualConstraints([constraint]))
    with pytest.raises(InvalidValue, match=r'map r0\.1 is retired by bob on .* "the old flat"'):
        PlaceResolver(Router(none), record("kitchen", Place(THERE))).resolve("kitchen")


def test_a_place_whose_node_is_retired_is_the_nearest_one_of_its_map(merged: MergedMap):
    left = {node: placement for node, placement in merged.poses.items() if node != THERE}
    without = replace(merged, poses=left, components=(frozenset(left),))
    at = merged.maps[THERE.map].nodes[THERE].map_from_robot.mean
    own = merged.maps[THERE.map].nodes
    nearest = min(left, key=lambda node: at.distance(own[node].map_from_robot.mean))
    found = PlaceResolver(Router(without), record("kitchen", Place(THERE))).resolve("kitchen")
    assert found.node == nearest and "r0.1.3 takes no part" in found.note


def test_an_area_is_the_active_node_next_to_its_centre(merged: MergedMap):
    anchor, (x, y) = merged.pose(THERE), (merged.pose(THERE).x, merged.pose(THERE).y)
    area = Area.of_merged(
        min(merged.poses),
        merged.pose(min(merged.poses)),
        [(x - 0.05, y - 0.04), (x + 0.05, y - 0.04), (x + 0.05, y + 0.04), (x - 0.05, y + 0.04)],
    )
    places = PlaceResolver(Router(merged), record("desk", Place(area=area)))
    assert places.resolve("desk").node == THERE
    assert places.name_at(0, anchor) == "desk" and places.name_at(0, Pose2(x + 0.1, y)) == ""
    far = Place(area=Area.around(THERE, 0.5))
    shifted = replace(far.area, corners=tuple((px + 20.0, py) for px, py in far.area.corners))
    with pytest.raises(InvalidValue, match="in which no node is active"):
        PlaceResolver(Router(merged), record("yard", Place(area=shifted))).resolve("yard")


def test_the_narrowest_place_names_a_position(merged: MergedMap):
    first, second = sorted(merged.poses)[:2]
    entries = [
        Annotation("house", Place(area=Area.around(first, 9.0)), False, "", 1),
        Annotation("room", Place(area=Area.around(first, 4.0)), False, "", 2),
        Annotation("one", Place(first), False, "", 3),
        Annotation("two", Place(second), False, "", 4),
    ]
    places = PlaceResolver(Router(merged), Annotations(tuple(entries)))
    assert places.name_at(0, merged.pose(first)) == "one"
    assert places.name_at(0, merged.pose(second)) == "two"
    assert places.name_at(0, merged.pose(first) @ Pose2(3.5, 0.0)) == "room"
    assert places.name_at(0, merged.pose(first) @ Pose2(0.0, 7.0)) == "house"
    assert places.name_at(1, merged.pose(first)) == ""


def test_places_of_a_map_file_from_the_shell(fetched: MapFile, tmp_path, capsys):
    path, other = tmp_path / "room.mapweave", tmp_path / "other.mapweave"
    write_map_file(path, fetched)

    def run(*words: str) -> tuple[int, str, str]:
        status = main([*words, "--map", str(path)])
        return status, *capsys.readouterr()

    assert run("place", "list")[1] == "no place has a name yet: mapweave place add NAME NODE\n"
    status, out, _ = run("place", "add", "kitchen", "r0.1.3", "--by", "anna", "--because", "tea")
    assert (status, out) == (0, 'place kitchen is node r0.1.3, by anna: "tea"\n')
    assert run("place", "add", "hall", "kitchen", "--radius", "2")[0] == 0
    assert run("place", "add", "cube", "--corners", "0,0", "1,0", "1,1", "0,1", "--near", "kitchen")[0] == 0
    listed = json.loads(run("place", "list", "--json")[1])["places"]
    assert [(one["name"], one["at"] is not None) for one in listed] == [
        ("cube", True), ("hall", True), ("kitchen", True),
    ]  # fmt: skip
    assert "kitchen  node r0.1.3 (tea), by anna" in run("place", "list")[1]
    status, out, _ = run("map", "route", "kitchen", "r0.1.9", "--json")
    assert status == 0 and json.loads(out)["start"] == "r0.1.3"
    assert "r0.1.3" in run("map", "explain", "kitchen", "r0.1.9")[1]
    for where, what in (("kitchen", "node r0.1.3 is retired"), ("hall", "the area of 16 corners at r0.1.3")):
        status, out, _ = run("map", "retire", where, "--check")
        assert status == 0 and out.startswith(f"only checked, nothing is changed: {what}"), out
    assert run("map", "retire", "hall", "kitchen", "--check")[0] == USAGE
    assert run("map", "retire", "attic", "--check")[0] == NO
    assert run("map", "route", "kitschen", "r0.1.9") == (
        NO, "", "mapweave: 'kitschen' is no place of this map (is it kitchen?): give a node (r0.1.17), the "
        "name of a place, or a position in the merged map (3.1,-2.0)\n",
    )  # fmt: skip
    for wrong in (["add", "x"], ["add", "x", "r0.1.3", "--corners", "0,0"], ["add", "r0.1", "r0.1.3"],
                  ["add", "x", "r0.1.3", "--radius", "-1"], ["add", "x", "--corners", "0,0", "1,0"],
                  ["add", "x", "--corners", "0,0", "1,0", "nan,1"],
                  ["add", "x", "r0.1.3", "--radius", "nan"]):  # fmt: skip
        status, _, err = run("place", *wrong)
        assert status == USAGE and err.count("\n") == 1, wrong
    for refused in (["remove", "attic"], ["add", "x", "r0.1.99"]):
        status, _, err = run("place", *refused)
        assert status == NO and err.count("\n") == 1, refused
    assert main(["place", "remove", "hall", "--map", str(path), "-o", str(other)]) == 0
    assert [one.name for one in read_map_file(other).annotations] == ["kitchen", "hall", "cube", "hall"]
    assert len(read_map_file(path).annotations) == 3, "the first file is as it was"
    assert main(["map", "history", "--map", str(other)]) == 0
    assert "annotated    place hall is withdrawn" in capsys.readouterr().out
    both = tmp_path / "both.mapweave"
    assert main(["map", "merge", str(path), str(other), "-o", str(both)]) == 0
    assert len(read_map_file(both).annotations) == 4


def test_a_floor_parts_maps_and_answers_name_it(tmp_path, capsys):
    """Two robots in twin rooms, which a running server has merged, until people say that they are not one."""
    rng, path = np.random.default_rng(6), tmp_path / "s0.sqlite"
    world, maps = room(0, 0, 5, 4, 700, rng), [MapId("r0", 1), MapId("r1", 1)]
    write_store(path, map_tours(world, dict.fromkeys(maps, looking_around(4)), rng))
    hub = MemoryHub()
    bus, mine = MemoryBus(hub), MemoryBus(hub)
    person, first = Fleet(fleet="fleet", by="anna", bus=mine), NodeId("r0", 1, 1)
    view = take_view(world, Pose2(2.45, 2.05, 0.05), np.random.default_rng(5))[0]
    for labels in (True, False):
        with MapServer(bus, KEYS, path, "s0") as server:
            eventually(lambda: server.status()["components"] == (1 if labels else 2))  # noqa: B023
            if labels:
                assert "map r0.1" not in person.annotate("floor", "r0.1", node=str(first), label="ground")
                with pytest.raises(InvalidValue, match=r"floor of map r1\.1 cannot be called 'r0.1'"):
                    person.annotate("floor", "r0.1", node="r1.1.1", label="upper")
                upper = Annotation("r1.1", Floor(NodeId("r1", 1, 1), "upper"), False, "anna", 1)
                count = len(server.merged().links)
                falls = f"{count} links fall and r1.1 parts from r0.1"
                for check in (True, False):
                    with pytest.raises(InvalidValue, match=rf"{falls}\. If that is right, .* needs a reason"):
                        server.annotate(upper, check=check)
                assert server.annotations().floors.keys() == {maps[0]}
                said = server.annotate(replace(upper, because="twin rooms"), check=True)
                assert said.endswith(f"; {falls}"), said
                said = person.annotate("floor", "r1.1", "twin rooms", node="r1.1.1", label="upper")
                assert said.endswith(f"; {falls}"), said
                eventually(lambda: server.status()["components"] == 2)
            answer = server.locate(lambda: view, 1).result(20.0)
            assert {candidate.floor for candidate in answer.candidates} <= {"ground", "upper"}
            assert answer.candidates and answer.certainty is not Certainty.FOUND, "it may be on either floor"
            for near, floor in ((first, "ground"), (NodeId("r1", 1, 3), "upper")):
                known = server.locate(lambda: replace(view, near=near), near.number).result(20.0)  # noqa: B023
                assert known.certainty is Certainty.FOUND, "a robot that knows its floor is on that"
                assert {place.floor for place in known.candidates} == {floor}
            if not labels:
                person.withdraw("floor", "r1.1")
                eventually(lambda: server.status()["components"] == 1)
    for one in (bus, mine):
        one.close()


def test_a_map_that_a_server_is_given_brings_its_annotations(fetched: MapFile, tmp_path):
    named = replace(fetched, annotations=record("kitchen", Place(THERE)).made)
    hub = MemoryHub()
    bus, mine = MemoryBus(hub), MemoryBus(hub)
    person = Fleet(fleet="fleet", by="bob", bus=mine)
    with MapServer(bus, KEYS, tmp_path / "s0.sqlite", "s0", base=BaseMap.of("room", named)) as server:
        eventually(lambda: server.status()["nodes"] == 7)
        assert person.resolve(ResolveRequest(("kitchen",))).found[0].node == THERE
        person.withdraw("place", "kitchen")
    with MapServer(bus, KEYS, tmp_path / "s0.sqlite", "s0", base=BaseMap.of("room", named)):
        assert [entry.removed for entry in person.annotations().made] == [False, True]
    bus.close()
    mine.close()
