"""Floor plans and pins of a running server, of its map file, and over HTTP."""

import hashlib
import json
import math
import re
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from mapweave.cli import main
from mapweave.exit_status import FAILED, NO, USAGE
from mapweave.file_map import FileMap
from mapweave.fleet import Fleet
from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.floor_plan import PIECE, PlanPiece
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.map_event import MapEventKind
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import ResolveRequest
from mapweave.login import login
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.mapserver.plan_answers import answer_on_plan, goal_on_plan
from mapweave.storage.map_file import MapFile, read_map_file, unpack_map_file, write_map_file
from mapweave.storage.plan_image import plan_file
from mapweave.wire.typed import packed
from tests.mapserver.house import House
from tests.mapserver.http.client import ask
from tests.mapserver.stub_services import picture, two_maps
from tests.waiting import eventually

SCALE = 0.02
PLAN_FROM_MERGED = Pose2(4.0, 5.0, 0.5)
PLACES = [(0.0, 0.0), (3.0, 0.0), (3.0, 2.5), (-1.0, 2.0)]
PNG = plan_file(cv2.imencode(".png", np.full((500, 400), 200, np.uint8))[1].tobytes(), "flat.png")


def pixel(x: float, y: float) -> tuple[float, float]:
    """Of a position in the merged map."""
    u, up = PLAN_FROM_MERGED.apply(np.array([x, y])) / SCALE
    return float(u), 500.0 - float(up)


def fields() -> dict[str, object]:
    pairs = [{"at": f"{x},{y}", "u": pixel(x, y)[0], "v": pixel(x, y)[1]} for x, y in PLACES]
    return {"pairs": pairs, "image": packed(PNG.image), "metres_per_pixel": SCALE}


def pose_of(fleet: Fleet, node: NodeId) -> Pose2:
    return fleet.resolve(ResolveRequest((str(node),))).found[0].merged_from_node


def map_of(fleet: Fleet) -> MapFile:
    return unpack_map_file(fleet.map_bytes())


def with_plan(house: House) -> Fleet:
    """A person in a house whose map lies under plan flat."""
    house.person.put_plan_image(PNG.png)
    assert house.server.settle(20.0)
    house.person.annotate("plan", "flat", **fields())
    return house.person


def test_a_plan_lies_under_the_map_of_a_server_and_outlasts_it(house: House):
    fleet = house.person
    assert house.server.settle(20.0)
    with pytest.raises(InvalidValue, match="the image of this plan is not on the server"):
        fleet.annotate("plan", "flat", **fields())
    assert fleet.put_plan_image(PNG.png).sha256 == PNG.image.sha256
    with pytest.raises(InvalidValue, match="3 are needed"):
        fleet.annotate("plan", "flat", **{**fields(), "pairs": fields()["pairs"][:2]})  # type: ignore[index]
    assert fleet.annotate("plan", "flat", **fields()) == "plan flat is flat.png, 4 pairs, 0.02 m/px, by anna"
    for _ in range(2):
        assert house.server.settle(20.0)
        placed = fleet.plans().plan("flat")
        assert np.allclose(placed.part().plan_from_merged.vector, PLAN_FROM_MERGED.vector, atol=1e-6)
        assert fleet.plan_image(placed.plan.image.sha256) == PNG.png
        house.restart_server()
    content = map_of(fleet)
    assert content.images == {PNG.image.sha256: PNG.png}
    # One whose image the disk has damaged takes no map along.
    (kept,) = house.mapped.path.with_name(f"{house.mapped.path.name}.plans").iterdir()
    for damaged in (b"", PNG.png[:-1]):
        kept.write_bytes(damaged)
        # The packed map is kept as long as nothing changes.
        house.restart_server()
        assert house.server.settle(20.0)
        assert len(map_of(fleet).poses) == 7 and map_of(fleet).images == {}
    fleet.withdraw("plan", "flat")
    assert fleet.plans().plans == () and map_of(fleet).images == {}


def test_a_plan_that_no_message_holds_is_refused(house: House):
    """It would cost people the answer about all plans."""
    fleet = with_plan(house)
    places = ((1e6, 1e6, 1.0, 1.0), (1e6, -1e6, 11.0, 1.0), (-1e6, 1e6, 1.0, 11.0))
    pairs = [{"node": "r0.1.1", "x": x, "y": y, "u": u, "v": v} for x, y, u, v in places]
    with pytest.raises(InvalidValue, match="plans: Expected"):
        fleet.annotate("plan", "moon", **{**fields(), "pairs": pairs, "metres_per_pixel": None})
    assert [plan.name for plan in fleet.plans().plans] == ["flat"]


def test_a_pinned_frame_is_what_everything_of_a_server_is_in(house: House):
    fleet, node, pose = with_plan(house), NodeId("r0", 1, 3), Pose2(50.0, -20.0, 1.5)
    before = fleet.plans().plan("flat").part().plan_from_merged @ pose_of(fleet, node)
    said = fleet.annotate("pin", str(node), node=str(node), merged_from_node=packed(pose))
    assert said == "pin r0.1.3 is at 50.000,-20.000 m, 85.9 deg, by anna"
    eventually(lambda: pose_of(fleet, node) == pose)
    # What lies on the plan does not move with the frame.
    after = fleet.plans().plan("flat").part().plan_from_merged @ pose
    assert np.allclose(after.vector, before.vector, atol=1e-6)
    assert merged_of(map_of(fleet)).pose(node) == pose
    house.restart_server()
    assert pose_of(fleet, node) == pose, "also before nodes are compared"
    assert house.server.settle(20.0)
    # A pin without a pose holds its node where it is.
    fleet.annotate("pin", "second", node="r0.1.5")
    second = fleet.annotations().last("pin", "second")
    eventually(lambda: MapEventKind.FRAME in {event.kind for event in house.server.history()})
    assert second is not None
    assert np.allclose(second.body.merged_from_node.vector, pose_of(fleet, NodeId("r0", 1, 5)).vector)
    fleet.withdraw("pin", str(node))
    with pytest.raises(InvalidValue, match="give a position within"):
        fleet.annotate("pin", str(node), node=str(node), merged_from_node=[2e5, 0.0, 0.0])


def test_an_image_comes_in_pieces_and_in_order(house: House):
    fleet, rng = house.person, np.random.default_rng(0)
    noise = rng.integers(0, 255, (900, 900, 3)).astype(np.uint8)
    png = cv2.imencode(".png", noise)[1].tobytes()
    assert len(png) > 3 * PIECE
    assert fleet.plan_image(fleet.put_plan_image(png).sha256) == png
    sha256, plans = hashlib.sha256(png).hexdigest(), house.server._plans
    plans.receive(PlanPiece(sha256, len(png), 0, png[:1000]))
    with pytest.raises(InvalidValue, match="a piece of the image is missing"):
        plans.receive(PlanPiece(sha256, len(png), 2000, png[2000:3000]))
    with pytest.raises(InvalidValue, match="damaged on its way"):
        plans.receive(PlanPiece(sha256, 4, 0, b"oops"))
    for number in range(20):
        plans.receive(PlanPiece(f"{number:064d}", 10, 0, b"begun"))
    assert len(plans._incoming) == 4


def test_plans_over_http(house: House):
    assert house.server.settle(20.0)
    with Web(("127.0.0.1", 0), house.server) as served:
        jpeg = cv2.imencode(".jpg", np.full((500, 400), 200, np.uint8))[1].tobytes()
        status, _, body = ask(served, "POST", "/plans", jpeg)
        image = json.loads(body)
        assert status == 200 and (image["width"], image["height"]) == (400, 500)
        posted = {"name": "flat/1", "body": {"kind": "plan", **fields(), "image": image}}
        assert ask(served, "POST", "/annotations", json.dumps(posted).encode())[0] == 200
        status, _, body = ask(served, "GET", "/plans")
        (plan,) = json.loads(body)["plans"]
        (part,) = plan["parts"]
        assert status == 200 and plan["name"] == "flat/1"
        a, b, c, d, e, f = part["merged_from_image"]
        u, v = pixel(3.0, 2.5)
        assert (a * u + c * v + e, b * u + d * v + f) == pytest.approx((3.0, 2.5), abs=1e-6)
        status, headers, png = ask(served, "GET", "/plans/flat%2F1.png")
        assert (status, headers["Content-Type"]) == (200, "image/png")
        assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (500, 400)
        assert ask(served, "GET", "/plans/none.png")[0] == 400
        assert ask(served, "POST", "/plans", b"a page")[0] == 400


def test_answers_and_goals_in_coordinates_of_a_plan(house: House):
    """Of robots and photographs, over HTTP and in Python; what is no plan is refused, and not passed over."""
    fleet = with_plan(house)
    house.robot()
    (robot,) = fleet.status(plan="flat").robots
    assert robot.merged_from_robot is not None and robot.plan_from_robot is not None
    on_plan = (PLAN_FROM_MERGED @ robot.merged_from_robot).vector
    assert np.allclose(robot.plan_from_robot.vector, on_plan, atol=1e-6)
    photo = picture()
    with Web(("127.0.0.1", 0), house.server) as served:
        status, _, body = ask(served, "GET", "/robots?plan=flat")
        assert status == 200
        assert json.loads(body)["robots"][0]["plan_from_robot"] == pytest.approx(on_plan, abs=1e-6)
        assert "plan_from_robot" not in json.loads(ask(served, "GET", "/robots")[2])["robots"][0]
        for method, path, data in (
            ("GET", "/robots?plan=none", None),
            ("POST", "/relocalize?plan=none", photo),
            ("POST", "/robots/r0/go?goal=1,1&plan=none", None),
        ):
            status, _, body = ask(served, method, path, data)
            assert status == 400 and "no plan 'none'; there are: flat" in json.loads(body)["error"], path
        status, _, body = ask(served, "POST", "/relocalize?plan=flat", photo)
        assert (status, json.loads(body)["certainty"]) == (200, "unknown"), "not of this room"
        node = sorted(house.mapped.truth)[3]
        at = PLAN_FROM_MERGED.apply(np.array([pose_of(fleet, node).x, pose_of(fleet, node).y]))
        goal = f"{at[0]:.3f},{at[1]:.3f}"
        status, _, body = ask(served, "POST", f"/robots/r0/go?goal={goal}&plan=flat")
        assert (status, json.loads(body)["order"]["node"]) == (200, str(node))
        assert ask(served, "POST", "/robots/r0/stop?plan=none")[0] == 200, "a stop stops"
    for to, by in ((goal, "5,6"), (at, (5, 6))):
        report = fleet.go("r0", to, via=[by], plan="flat")
        assert report.order.node == node and len(report.order.via) == 1
    assert fleet.go("r0", (pose_of(fleet, node).x, pose_of(fleet, node).y)).order.node == node
    assert fleet.go("r0", str(node), plan="flat").order.node == node, "what is no position is as without"
    assert fleet.place("spot", goal, plan="flat") == f"place spot is node {node}, by anna"
    with Web(("127.0.0.1", 0), house.server) as served:
        for plan, status, words in (
            ("flat", 200, f"place sink is node {node}, by"),
            ("none", 400, "no plan 'none'"),
        ):
            body = {"kind": "place", "node": goal, "plan": plan}
            answer = ask(served, "POST", "/annotations", json.dumps({"name": "sink", "body": body}).encode())
            assert answer[0] == status and words in answer[2].decode(), answer
    with pytest.raises(InvalidValue, match="no plan 'none'"):
        fleet.go("r0", goal, plan="none")
    with pytest.raises(InvalidValue, match="no plan 'none'"):
        fleet.status(plan="none")


def test_a_photograph_is_placed_on_the_plan_of_a_file(house: House):
    fleet = with_plan(house)
    node = sorted(house.mapped.truth)[2]
    answer = house.server.locate(lambda: house.mapped.view(node), 1).result(20.0)
    placed = answer_on_plan(answer, fleet.plans().plan("flat"))
    best = placed.candidates[0]
    assert answer.candidates and best.merged_from_robot is not None and best.plan_from_robot is not None
    expected = (PLAN_FROM_MERGED @ best.merged_from_robot.mean).vector
    assert np.allclose(best.plan_from_robot.vector, expected, atol=1e-6)
    office = FileMap(map_of(fleet))
    assert [plan.name for plan in office.plans().plans] == ["flat"]
    camera = house.mapped.view(node).camera
    blank = np.zeros((camera.height, camera.width), np.uint8)
    assert office.relocalize(blank, camera, plan="flat").candidates == ()
    with pytest.raises(Refused, match="no plan 'none'; there are: flat"):
        office.relocalize(blank, camera, plan="none")


def test_a_position_on_a_plan_under_two_parts_needs_to_know_where_the_robot_is(house: House):
    fleet = with_plan(house)
    plan = fleet.plans().plan("flat")
    two = replace(plan, parts=(*plan.parts, replace(plan.part(), component=1)))
    assert goal_on_plan("4,5", two, 0, fleet.resolve) == goal_on_plan("4,5", plan, -1, fleet.resolve)
    with pytest.raises(Refused, match="lies under 2 parts of the map, and it is not known in which"):
        goal_on_plan("4,5", two, -1, fleet.resolve)
    with pytest.raises(Refused, match="does not lie under component 1"):
        goal_on_plan("4,5", plan, 1, fleet.resolve)
    with pytest.raises(Refused, match="othing is mapped within 2 m of"):
        goal_on_plan("400,500", plan, 0, fleet.resolve)


def test_a_plan_is_tried_over_http_before_it_is_kept(house: House):
    """The image may come with its map.yaml; the fit comes without anything being kept."""
    assert house.server.settle(20.0)
    described = "image: flat.pgm\nresolution: 0.02\norigin: [1.0, -2.0, 0.5]\nnegate: 1\n"
    pgm = cv2.imencode(".pgm", np.full((500, 400), 200, np.uint8))[1].tobytes()

    def form(words: str) -> tuple[int, dict[str, Any]]:
        parts = (("map", words.encode()), ("image", pgm))
        body = b"".join(
            f'--b\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode() + data + b"\r\n"
            for name, data in parts
        )
        headers = {"Content-Type": "multipart/form-data; boundary=b"}
        status, _, content = ask(served, "POST", "/plans", body + b"--b--\r\n", headers)
        return status, json.loads(content)

    def try_out(**body: Any) -> tuple[int, dict[str, Any]]:
        posted = {"name": "flat", "body": {"kind": "plan", **body}, "check": True}
        status, _, content = ask(served, "POST", "/annotations", json.dumps(posted).encode())
        return status, json.loads(content)

    with Web(("127.0.0.1", 0), house.server) as served:
        status, kept = form(described)
        assert status == 200 and kept["metres_per_pixel"] == 0.02 and kept["origin"] == [1.0, -2.0, 0.5]
        png = ask(served, "GET", f"/plan-images/{kept['sha256']}.png")[2]
        assert (cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE) == 55).all(), "negated"
        assert form(described.replace("0.02", "-1")) == (
            400,
            {"error": "map.yaml: resolution -1: give metres in a pixel, for example 0.05"},
        )
        assert ask(served, "GET", f"/plan-images/{'0' * 64}.png")[0] == 503
        image = {name: kept[name] for name in ("sha256", "width", "height", "file")}
        known = {**fields(), "image": image}
        status, answer = try_out(**known)
        (part,) = answer["plan"]["parts"]
        assert status == 200 and answer["said"].startswith("only checked, nothing is changed: plan flat is")
        assert part["plan_from_merged"] == pytest.approx(PLAN_FROM_MERGED.vector.tolist(), abs=1e-6)
        assert [pair["off"] for pair in part["pairs"]] == pytest.approx([0.0] * 4, abs=1e-6)
        status, answer = try_out(**{**known, "pairs": fields()["pairs"][:2]})  # type: ignore[index]
        assert status == 400 and "3 are needed" in answer["error"]
        assert json.loads(ask(served, "GET", "/annotations")[2]) == {"annotations": []}
        assert house.server.plans().plans == ()


def test_a_plan_of_a_server_is_drawn(house: House, tmp_path, monkeypatch, capsys):
    """Before, `-o` was taken for where a changed record goes, and refused."""
    assert house.server.settle(20.0)
    house.person.put_plan_image(PNG.png)
    house.person.annotate("plan", "flat", **fields())
    monkeypatch.setattr("mapweave.commands.annotating.fleet_of", lambda _: nullcontext(house.person))
    picture = tmp_path / "plan.png"
    assert main(["plan", "show", "flat", "-o", str(picture)]) == 0
    assert capsys.readouterr().out.endswith(f"{picture}\n")
    assert cv2.imread(str(picture)).shape[0] > 300


def test_a_pixel_outside_of_the_image_is_refused(house: House):
    """Of a pixel with a zero too many it was said that some pair is wrong."""
    assert house.server.settle(20.0)
    house.person.put_plan_image(PNG.png)
    pairs = fields()["pairs"]
    for u, v in ((4000.0, 30.0), (-1.0, 30.0), (30.0, 5000.0)):
        wrong = [*pairs, {"at": "r0.1.3", "u": u, "v": v}]  # type: ignore[misc]
        words = f"pair 5 (r0.1.3): pixel {u:g},{v:g} is outside of the image, which is 400 x 500 px"
        with pytest.raises(InvalidValue, match=re.escape(words)):
            house.person.annotate("plan", "flat", **{**fields(), "pairs": wrong})
    assert house.server.plans().plans == ()


def test_a_map_yaml_whose_image_is_missing_is_named(tmp_path, capsys):
    described = tmp_path / "map.yaml"
    described.write_text("image: flat.pgm\nresolution: 0.02\norigin: [1.0, -2.0, 0.5]\nnegate: 1\n")
    assert main(["plan", "add", str(described), "--pair", "r0.1.3=1,2"]) == FAILED
    said = f"mapweave: the image that {described} names, {tmp_path / 'flat.pgm'}: cannot be read"
    assert capsys.readouterr().err.startswith(said)


@pytest.mark.slow
def test_plans_and_pins_of_a_map_file_from_the_shell(house: House, tmp_path, capsys):
    path, image = tmp_path / "room.mapweave", tmp_path / "flat.pgm"
    house.person.annotate("place", "door", node="r0.1.9")
    write_map_file(path, map_of(house.person))
    cv2.imwrite(str(image), np.full((500, 400), 200, np.uint8))
    (tmp_path / "flat.yaml").write_text(
        f"image: flat.pgm\nresolution: {SCALE}\norigin: [1.0, 2.0, 0.0]\nnegate: 0\n"
    )
    door = merged_of(read_map_file(path)).pose(NodeId("r0", 1, 9))
    pairs = [f"{x},{y}={','.join(map(str, pixel(x, y)))}" for x, y in PLACES]
    pairs.append(f"door={','.join(map(str, pixel(door.x, door.y)))}")
    words = [word for pair in pairs for word in ("--pair", pair)]

    def run(*words: str) -> tuple[int, str, str]:
        status = main([*words, "--map", str(path)])
        return status, *capsys.readouterr()

    status, out, err = run("plan", "add", str(tmp_path / "flat.yaml"), *words, "--by", "anna")
    assert (status, err) == (0, "")
    assert out.startswith("plan flat is flat.pgm, 5 pairs, 0.02 m/px, by anna\n")
    assert "residuals 0.00 m rms" in out and "doubtful" not in out
    content = json.loads(run("plan", "show", "flat", "--json")[1])["plans"][0]
    expected = Pose2(1.0, 2.0, 0.0) @ PLAN_FROM_MERGED
    assert content["parts"][0]["plan_from_merged"] == pytest.approx(expected.vector.tolist(), abs=1e-6)
    for name, found in {"rmf": "reference_coordinates:", "nav2": "origin: [", "tf": "--frame-id map"}.items():
        status, out, _ = run("plan", "export", "flat", "--format", name)
        assert status == 0 and found in out
    picture = tmp_path / "plan.png"
    assert run("plan", "show", "flat", "-o", str(picture))[0] == 0
    assert cv2.imread(str(picture)).shape[0] > 300
    # Exports in the coordinates of the plan.
    assert main(["map", "export", str(path), "--format", "tum", "-o", str(tmp_path / "a.tum")]) == 0
    with_plan = ["map", "export", str(path), "--format", "tum", "--plan", "flat"]
    assert main([*with_plan, "-o", str(tmp_path / "b.tum")]) == 0
    free, moved = (np.loadtxt(tmp_path / f"{name}.tum")[:, 1:3] for name in "ab")
    assert np.allclose(expected.apply(free), moved, atol=1e-5)
    capsys.readouterr()
    # A pin moves the poses of the file, and the plan with them.
    assert run("map", "pin", "door", "-3,4.5,90") == (
        0, f"pin r0.1.9 is at -3.000,4.500 m, 90.0 deg, by {login()}\n", ""
    )  # fmt: skip
    pinned = read_map_file(path)
    _, pose = pinned.poses[NodeId("r0", 1, 9)]
    assert np.allclose(pose.mean.vector, [-3.0, 4.5, math.pi / 2])
    assert merged_of(pinned).pose(NodeId("r0", 1, 9)) == Pose2(-3.0, 4.5, math.radians(90.0))
    assert "residuals 0.00 m rms" in run("plan", "show")[1]
    assert "r0.1.9 at -3.000,4.500 m" in run("map", "pin")[1]
    both = tmp_path / "both.mapweave"
    assert main(["map", "merge", str(path), "-o", str(both)]) == 0
    assert merged_of(read_map_file(both)).pose(NodeId("r0", 1, 9)) == Pose2(-3.0, 4.5, math.radians(90.0))
    assert read_map_file(both).images == pinned.images != {}
    capsys.readouterr()
    assert run("map", "pin", "r0.1.9", "--undo")[0] == 0
    assert run("map", "pin")[1] == "nothing is pinned: mapweave map pin NODE\n"
    assert run("plan", "remove", "flat")[0] == 0 and run("plan", "show")[1] == "there is no plan\n"
    assert read_map_file(path).images == {}


@pytest.mark.parametrize(
    ("words", "reason", "status"),
    [
        (["plan", "add", "none.png", "--pair", "r0.1.3=1,2"], "cannot be read", FAILED),
        (["plan", "add", "none.yaml", "--pair", "r0.1.3=1,2"], "cannot be read", FAILED),
        (["plan", "add", "none.png", "--pair", "r0.1.3"], "write r0.1.17=412,230", USAGE),
        (["plan", "add", "none.png", "--pair", "r0.1.3=1,nan"], "write r0.1.17=412,230", USAGE),
        (["plan", "add", "none.png", "--pair", "=1,2"], "write r0.1.17=412,230", USAGE),
        (
            ["plan", "add", "none.yaml", "--pair", "r0.1.3=1,2", "--metres-per-pixel", "0.1"],
            "has its resolution",
            USAGE,
        ),
        (
            ["plan", "add", "none.png", "--pair", "r0.1.3=1,2", "--metres-per-pixel", "-1"],
            "give metres",
            USAGE,
        ),
        (["plan", "export", "none", "--format", "tf"], "there is no plan 'none'", NO),
        (["map", "pin", "r0.1.3", "1,2"], "give x,y,heading", USAGE),
        (["map", "pin", "r0.1.3", "nan,2,3"], "give x,y,heading", USAGE),
        (["map", "pin", "--undo"], "name the node", USAGE),
    ],
)
def test_mistakes_are_refused_in_one_line(tmp_path, capsys, words: list[str], reason: str, status: int):
    path = tmp_path / "room.mapweave"
    write_map_file(path, map_file_of(two_maps()))
    before = path.read_bytes()
    assert main([*words, "--map", str(path)]) == status
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1) and reason in err
    assert path.read_bytes() == before
