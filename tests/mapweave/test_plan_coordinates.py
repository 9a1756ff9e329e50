"""Coordinates of a floor plan, where commands and Python take and give positions in the merged map."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mapweave
from mapweave import MapId, read_map_file, write_map_file
from mapweave.cli import main
from mapweave.exit_status import NO, USAGE
from mapweave.hybridmap.annotation import Annotations, Closure, Floor, Place
from mapweave.hybridmap.portal import Portal
from mapweave.mapserver.map_files import map_file_of
from mapweave.storage.plan_image import plan_file
from synthetic.maps import changes_of, merger_of
from synthetic.world import room as room_of
from synthetic.world import take_map

SCALE, HEIGHT = 0.02, 500
AT, HEADING = np.array([4.0, 5.0]), 0.5
PLACES = [(0.0, 0.0), (3.0, 0.0), (3.0, 2.5), (-1.0, 2.0)]
ROTATION = np.array([[math.cos(HEADING), -math.sin(HEADING)], [math.sin(HEADING), math.cos(HEADING)]])

Floats = NDArray[np.float64]


def on_plan(points: Floats) -> Floats:
    """(N, 2) m on the plan, of (N, 2) m in the merged map."""
    return AT + points @ ROTATION.T


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots' maps of one room, merged, over a plan that lies on it as `on_plan` says."""
    rng = np.random.default_rng(6)
    world = room_of(0, 0, 5, 4, 600, rng)
    tour = [mapweave.Pose2(1.0 + 0.6 * k, 1.5 + 0.1 * k, 0.9 * k) for k in range(5)]
    maps = (MapId("r0", 1), MapId("r1", 1))
    merged = merger_of({one: changes_of(*take_map(world, one, tour, rng)) for one in maps}).merged()
    path = tmp_path_factory.mktemp("map") / "room.mapweave"
    write_map_file(path, map_file_of(merged))
    room = mapweave.open(path)
    png = cv2.imencode(".png", np.full((HEIGHT, 400), 200, np.uint8))[1].tobytes()
    image = room.put_plan_image(plan_file(png, "flat.png").png)
    pixels = on_plan(np.array(PLACES)) / SCALE
    pairs = [(f"{x},{y}", u, HEIGHT - up) for (x, y), (u, up) in zip(PLACES, pixels.tolist(), strict=True)]
    room.plan("flat", image, pairs, metres_per_pixel=SCALE)
    room.save(path)
    return path


@pytest.fixture
def copy(planned: Path, tmp_path: Path) -> Path:
    """A file that may be changed."""
    path = tmp_path / "room.mapweave"
    path.write_bytes(planned.read_bytes())
    return path


def positions(room: mapweave.Map) -> Floats:
    """(N, 2) of the nodes, in the merged map, m."""
    return np.column_stack([room.nodes.x, room.nodes.y])


def farthest(room: mapweave.Map) -> tuple[str, str]:
    """The node in use that is farthest from the middle, and its position on the plan in words."""
    points = positions(room)
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    k = int(np.where(room.nodes.superseded, -1.0, away).argmax())
    x, y = on_plan(points)[k]
    return str(room.nodes.ids[k]), f"{x:.3f},{y:.3f}"


def test_nodes_exports_and_plots_of_python(planned: Path, tmp_path):
    room = mapweave.open(planned)
    expected = on_plan(positions(room))
    nodes = room.nodes_on("flat")
    assert list(nodes.ids) == list(room.nodes.ids)
    assert np.allclose(np.column_stack([nodes.x, nodes.y]), expected, atol=1e-6)
    turned = (nodes.heading - room.nodes.heading - HEADING + math.pi) % (2 * math.pi) - math.pi
    assert np.allclose(turned, 0.0, atol=1e-6) and np.allclose(nodes.sigma, room.nodes.sigma)
    room.export(tmp_path / "room.geojson", plan="flat")
    features = json.loads((tmp_path / "room.geojson").read_text())["features"]
    points = [f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "Point"]
    assert np.allclose(sorted(points), sorted(expected.tolist()), atol=1e-3)
    by_shell = tmp_path / "shell.geojson"
    words = ["map", "export", str(planned), "--format", "geojson", "--plan", "flat", "-o", str(by_shell)]
    assert main(words) == 0
    assert by_shell.read_bytes() == (tmp_path / "room.geojson").read_bytes()
    drawn = room.plot(landmarks=False, plan="flat").dataLim
    assert np.allclose(drawn.intervalx, [expected[:, 0].min(), expected[:, 0].max()], atol=0.5)
    assert np.allclose(drawn.intervaly, [expected[:, 1].min(), expected[:, 1].max()], atol=0.5)
    for ask in (room.nodes_on, lambda plan: room.export(tmp_path / "no.g2o", plan=plan)):
        with pytest.raises(mapweave.Refused, match="no plan 'none'; there are: flat"):
            ask("none")
    with pytest.raises(mapweave.Refused, match="does not lie under component 1"):
        room.export(tmp_path / "no.g2o", component=1, plan="flat")


def test_places_and_closures(copy: Path, capsys):
    node, at = farthest(mapweave.open(copy))
    words = ["--map", str(copy), "--plan", "flat"]
    assert main(["place", "add", "far", at, *words]) == 0
    assert main(["close", at, "--radius", "0.3", *words]) == 0
    said = Annotations(read_map_file(copy).annotations)
    (place,) = (one for _, one in said.in_force(Place))
    ((entry, closure),) = said.in_force(Closure)
    assert str(place.node) == node and isinstance(closure, Closure) and closure.area is not None
    assert (str(closure.area.anchor), entry.name) == (node, f"{at} on flat")
    # Corners keep their form: a square of the plan, turned.
    x, y = map(float, at.split(","))
    square = [(x - 0.5, y - 0.5), (x + 0.5, y - 0.5), (x + 0.5, y + 0.5), (x - 0.5, y + 0.5)]
    assert main(["place", "add", "box", "--corners", *(f"{u},{v}" for u, v in square), *words]) == 0
    room = mapweave.open(copy)
    (box,) = (one for entry, one in room.annotations().in_force(Place) if entry.name == "box")
    corners = box.area.polygon(room.pose(box.anchor).mean)
    assert np.allclose(on_plan(corners), square, atol=1e-6)
    assert room.place("again", at, plan="flat").startswith(f"place again is node {node}")
    assert main(["reopen", at, *words]) == 0
    assert Annotations(read_map_file(copy).annotations).in_force(Closure) == ()
    capsys.readouterr()
    used = ~room.nodes.superseded
    points = on_plan(positions(room))[used]
    away = np.linalg.norm(points - [40.0, 30.0], axis=1)
    (u, v), nearest = points[away.argmin()], room.nodes.ids[used][away.argmin()]
    words = (
        f"of 40,30 on plan flat: the nearest node is {nearest}, {away.min():.1f} m away at {u:.1f},{v:.1f}"
    )
    for command in (["place", "add", "gone", "40,30"], ["map", "route", "far", "40,30"], ["close", "40,30"]):
        assert main([*command, "--map", str(copy), "--plan", "flat"]) == NO
        assert words in capsys.readouterr().err
    assert main(["place", "add", "gone", at, "--map", str(copy), "--plan", "none"]) == NO
    assert "no plan 'none'; there are: flat" in capsys.readouterr().err


def test_a_route_from_position_to_position(planned: Path, capsys):
    room = mapweave.open(planned)
    goal, at = farthest(room)
    first, points = str(room.nodes.ids[0]), on_plan(positions(room))
    start = "{:.3f},{:.3f}".format(*points[0])
    words = ["map", "route", start, at, "--map", str(planned), "--plan", "flat"]
    assert main([*words, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    expected = dict(zip(map(str, room.nodes.ids), points, strict=True))
    for stop in values["stops"]:
        assert np.allclose(stop["plan_from_node"][:2], expected[stop["node"]], atol=1e-6)
    assert [stop["node"] for stop in values["stops"]][-1] == goal
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "on plan flat: {:.2f},{:.2f} m".format(*expected[goal]) in out.splitlines()[-1]
    assert main(["map", "route", first, goal, "--map", str(planned)]) == 0
    assert "on plan" not in capsys.readouterr().out
    way = room.route(start, at, plan="flat")
    assert str(way.goal) == goal and way.found


def test_floors_and_portals_on_the_plan(copy: Path, capsys):
    room = mapweave.open(copy)
    node, at = farthest(room)
    points, used = on_plan(positions(room)), ~room.nodes.superseded
    k = next(k for k in np.flatnonzero(used).tolist() if room.nodes.ids[k] != node)
    other, x, y = str(room.nodes.ids[k]), *points[k]
    words = ["--map", str(copy), "--plan", "flat"]
    assert main(["floor", "first", at, *words]) == 0
    assert main(["map", "portal", "add", "gate", at, f"{x:.3f},{y:.3f}", "--kind", "door", *words]) == 0
    said = Annotations(read_map_file(copy).annotations)
    ((_, floor),) = said.in_force(Floor)
    ((_, gate),) = said.in_force(Portal)
    assert (str(floor.node), str(gate.a), str(gate.b)) == (node, node, other)
    assert room.floor(at, "first", plan="flat")
    assert room.portal("gate", at, f"{x:.3f},{y:.3f}", "door", plan="flat")
    python = room.annotations()
    assert [body for _, body in python.in_force(Floor)] == [floor]
    assert [body for _, body in python.in_force(Portal)] == [gate]
    assert main(["floor", "--undo", at, *words]) == 0
    assert Annotations(read_map_file(copy).annotations).in_force(Floor) == ()
    capsys.readouterr()
    for command in (
        ["floor", "first", "40,30"],
        ["map", "portal", "add", "p", at, "40,30", "--kind", "door"],
    ):
        assert main([*command, *words]) == NO
        assert "of 40,30 on plan flat" in capsys.readouterr().err


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The maps of two rooms that have nothing in common; the second is the smaller part."""
    rng = np.random.default_rng(9)
    tours = {MapId("r0", 1): 6, MapId("r1", 1): 4}
    maps = {
        one: changes_of(
            *take_map(
                room_of(0, 0, 5, 4, 600, rng), one,
                [mapweave.Pose2(1.0 + 0.5 * k, 1.5 + 0.1 * k, 0.9 * k) for k in range(stops)], rng,
            )
        )
        for one, stops in tours.items()
    }  # fmt: skip
    path = tmp_path_factory.mktemp("map") / "apart.mapweave"
    write_map_file(path, map_file_of(merger_of(maps).merged()))
    return path


def test_positions_are_in_the_part_of_the_map_that_near_names(apart: Path, tmp_path, capsys):
    room = mapweave.open(apart)
    of_second = np.array([str(one).startswith("r1.") for one in room.nodes.ids])
    assert set(room.nodes.component[of_second]) == {1} and set(room.nodes.component[~of_second]) == {0}
    ids, points = list(map(str, room.nodes.ids)), positions(room)
    first, last = (k for k in np.flatnonzero(of_second & ~room.nodes.superseded)[[0, -1]].tolist())
    start, goal = (f"{points[k][0]:.3f},{points[k][1]:.3f}" for k in (first, last))
    command = ["map", "route", start, goal, "--json", "--map", str(apart)]
    assert main([*command, "--near", ids[last]]) == 0
    near = json.loads(capsys.readouterr().out)
    assert (near["start"], near["goal"]) == (ids[first], ids[last])
    main(command)
    far = json.loads(capsys.readouterr().out)
    assert far["start"].startswith("r0.") and far["goal"].startswith("r0.")
    way = room.route(start, goal, near=ids[last])
    assert (str(way.start), str(way.goal)) == (ids[first], ids[last])
    node = mapweave.NodeId.parse(ids[last])
    assert room.route(start, goal, near=node) == way
    for say in (
        lambda: room.floor(start, "2", near=node, check=True),
        lambda: room.place("there", start, near=node, check=True),
        lambda: room.portal("gate", start, goal, "door", near=node, check=True),
        lambda: room.close_way("wet", node=start, radius=1.0, near=node, check=True),
    ):
        assert say().startswith("only checked, nothing is changed: ")
    assert main([*command, "--near", "nowhere"]) == NO
    assert "'nowhere' is no place of this map" in capsys.readouterr().err
    path = tmp_path / "copy.mapweave"
    path.write_bytes(apart.read_bytes())
    assert main(["floor", "2", start, "--near", ids[last], "--map", str(path)]) == 0
    ((_, floor),) = Annotations(read_map_file(path).annotations).in_force(Floor)
    assert str(floor.node) == ids[first]
    words = ["map", "portal", "add", "gate", start, goal, "--kind", "door", "--map", str(path)]
    assert main([*words, "--near", ids[last]]) == 0
    ((_, gate),) = Annotations(read_map_file(path).annotations).in_force(Portal)
    assert (str(gate.a), str(gate.b)) == (ids[first], ids[last])


def test_an_area_of_the_plan_is_retired(copy: Path):
    room = mapweave.open(copy)
    node, at = farthest(room)
    x, y = map(float, at.split(","))
    points = on_plan(positions(room))
    inside = (np.abs(points[:, 0] - x) < 0.4) & (np.abs(points[:, 1] - y) < 0.1)
    corners = " ".join(f"{x + a},{y + b}" for a, b in ((-0.4, -0.1), (0.4, -0.1), (0.4, 0.1), (-0.4, 0.1)))
    other = next(str(one) for one in room.nodes.ids if one != node)
    words = ["map", "retire", "--area", other, corners, "--map", str(copy), "--plan", "flat"]
    assert main(words) == 0
    assert inside.any() and not inside.all()
    left = mapweave.open(copy).content.poses
    assert {str(one) for one in room.content.poses.keys() - left.keys()} == set(room.nodes.ids[inside])
    assert main(["map", "retire", node, "--map", str(copy), "--plan", "flat"]) == USAGE


def test_a_pin_gives_the_map_the_coordinates_of_the_plan(copy: Path, capsys):
    room = mapweave.open(copy)
    node, _ = farthest(room)
    expected = on_plan(positions(room))
    words = ["--map", str(copy), "--plan", "flat"]
    assert main(["map", "pin", node, "1,2,90", *words]) == USAGE
    assert "leave the pose out" in capsys.readouterr().err
    assert main(["map", "pin", node, *words]) == 0
    moved = mapweave.open(copy)
    assert np.allclose(positions(moved), expected, atol=1e-6)
    capsys.readouterr()
    assert main(["map", "pin", *words]) == 0
    x, y = expected[list(room.nodes.ids).index(node)]
    assert f"{node} on plan flat: {x:.2f},{y:.2f} m" in capsys.readouterr().out
    assert main(["map", "pin", "--json", *words]) == 0
    (pin,) = json.loads(capsys.readouterr().out)["pins"]
    assert np.allclose(pin["plan_from_node"][:2], [x, y], atol=1e-6)
    room.pin(node, plan="flat")
    assert np.allclose(positions(room), expected, atol=1e-6)
    with pytest.raises(mapweave.Refused, match="leave the pose out"):
        room.pin(node, mapweave.Pose2(), plan="flat")


def test_a_name_for_a_superseded_node_says_where_robots_go(copy: Path, capsys):
    room = mapweave.open(copy)
    node = str(room.nodes.ids[room.nodes.superseded][0])
    by = room.content.superseded[mapweave.NodeId.parse(node)].by
    assert main(["place", "add", "old", node, "--map", str(copy)]) == 0
    out = capsys.readouterr().out
    goal = str(mapweave.open(copy).resolve("old").found[0].node)
    assert out.endswith(f"; {node} is superseded by {by}; the nearest active node is {goal}\n")
    assert not room.nodes.superseded[list(room.nodes.ids).index(goal)]


@pytest.mark.parametrize("form", ["rmf", "nav2", "tf", "json"])
def test_an_export_of_a_plan_as_one_object(planned: Path, form: str, capsys):
    """`--json` was taken, and the other text was printed all the same."""
    words = ["plan", "export", "flat", "--format", form, "--map", str(planned)]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert main([*words, "--json"]) == 0
    out = capsys.readouterr().out
    values = json.loads(out)
    assert out.count("\n") == 1 and (values["plan"], values["component"]) == ("flat", 0)
    assert values[form] == (json.loads(text) if form == "json" else text)
