"""`mapweave relocalize` and its picture, against a map server over Zenoh in this process."""

import json
import re
import socket
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import Camera, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian, RelocalizeAnswer, View
from mapweave.agent.replication.journal import Journal
from mapweave.cli import main
from mapweave.drawing.match_picture import AGREES_PX, GREEN, Overlay, draw_matches
from mapweave.exit_status import NO
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import Busy
from mapweave.mapserver.server import MapServer
from mapweave.mapserver.services import Services
from mapweave.storage.map_file import MapFile, write_map_file
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import write_store
from tests.photo_walls import photograph, rendered
from tests.recordings import camera_toml

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
WALL = 2.4
"""Distance of the photographed wall from the node, m."""
MOVED = Pose2(0.3, 0.1, 0.06)
"""`node_from_robot` of the robot that asks."""


def picture(node_from_robot: Pose2) -> np.ndarray:
    """(240, 320) grey: one photograph on a wall and one, half hidden, half a metre behind it."""
    hung = [(photograph("coffee"), WALL + 0.6, 0.3, 1.6, 2.6), (photograph("astronaut"), WALL, 1.7, 1.2, 1.6)]
    return rendered(hung, CAMERA, node_from_robot, empty=90)


def view_of(image: np.ndarray) -> View:
    return Sift(Lens(CAMERA)).extract(image).view(CAMERA)


@pytest.fixture(scope="module")
def node() -> Node:
    """The place, with depths as they are."""
    view = view_of(picture(Pose2()))
    y = -(view.pixels[:, 0] - CAMERA.cx) / CAMERA.fx * WALL
    depths = np.where((y <= 1.7) & (y >= 0.1), WALL, WALL + 0.6).astype(np.float32)
    landmarks = Landmarks(view.pixels, view.codes, depths, (0.01 * depths).astype(np.float32))
    here = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
    return Node(NodeId("r0", 1, 1), 0, here, CAMERA, landmarks)


@pytest.fixture(scope="module")
def served(node: Node, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An endpoint where a map server knows the place."""
    path = write_store(tmp_path_factory.mktemp("server") / "s0.sqlite", {MapId("r0", 1): [NodePut(node)]})
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
    with MapServer(bus, Keys("demo"), path, "s0") as server:
        assert server.settle(30)
        yield endpoint
    bus.close()


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    cv2.imwrite(str(tmp_path / "moved.png"), picture(MOVED))
    (tmp_path / "camera.toml").write_text(camera_toml())
    return tmp_path / "moved.png"


def test_a_photograph_is_found_and_drawn(served: str, photo: Path, tmp_path, capfd):
    drawn = tmp_path / "matches.png"
    assert main(["relocalize", str(photo), "--connect", served, "--json", "--draw", str(drawn)]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert answer["certainty"] == "found"
    (place,) = answer["candidates"]
    assert place["node_from_robot"]["mean"] == pytest.approx([MOVED.x, MOVED.y, MOVED.heading], abs=0.03)
    image = cv2.imread(str(drawn))
    assert image.shape[1] > 2 * 320
    # Lines are smoothed.
    assert (np.abs(image.astype(int) - GREEN) < 40).all(axis=2).sum() > 1000
    # As people read it.
    assert main(["relocalize", str(photo), "--connect", served]) == 0
    result = re.search(r"node r0\.1\.1: (\S+) m ahead", capfd.readouterr().out)
    assert result is not None and float(result[1]) == pytest.approx(MOVED.x, abs=0.03)


def test_a_map_file_answers_without_a_server(node: Node, photo: Path, tmp_path, capfd):
    path, drawn = tmp_path / "place.mapweave", tmp_path / "matches.png"
    write_map_file(path, MapFile("agent", "r0.1", (NodePut(node),)))
    journal = Journal(tmp_path / "r0.sqlite", "r0")
    journal.append(journal.open_map(1), [NodePut(node)], 0)
    journal.close()
    before = path.read_bytes()
    answers = []
    for name in ("place.mapweave", "r0.sqlite"):
        arguments = ["--map", str(tmp_path / name), "--json", "--draw", str(drawn)]
        assert main(["relocalize", str(photo), *arguments]) == 0
        answers.append(json.loads(capfd.readouterr().out))
    assert answers[0] == answers[1]
    (place,) = answers[0]["candidates"]
    assert place["node_from_robot"]["mean"] == pytest.approx([MOVED.x, MOVED.y, MOVED.heading], abs=0.03)
    assert (np.abs(cv2.imread(str(drawn)).astype(int) - GREEN) < 40).all(axis=2).sum() > 1000
    assert path.read_bytes() == before
    cv2.imwrite(str(photo), np.full((240, 320), 90, np.uint8))
    assert main(["relocalize", str(photo), "--map", str(path)]) == NO
    assert main(["relocalize", str(photo), "--map", str(photo)]) == 1
    assert "is neither a map file" in capfd.readouterr().err


def test_unknown_values_are_not_drawn(served: str, photo: Path, tmp_path, capfd):
    cv2.imwrite(str(photo), np.full((240, 320), 90, np.uint8))
    drawn = tmp_path / "matches.png"
    assert main(["relocalize", str(photo), "--connect", served, "--draw", str(drawn)]) == NO
    output = capfd.readouterr()
    assert output.out.startswith("unknown: ")
    assert output.err == f"{drawn} is not drawn: no place was recognised\n"
    assert not drawn.exists()
    assert main(["relocalize", str(photo), "--connect", served, "--draw", str(tmp_path / "a.jpg")]) == 2
    assert "end its name with .png" in capfd.readouterr().err


def test_a_busy_server_is_asked_again(served: str, photo: Path, capfd, monkeypatch):
    real, asked = Services.locate, []

    def busy_twice(self: Services, *question) -> Future[RelocalizeAnswer]:
        asked.append(1)
        if len(asked) <= 2:
            raise Busy(0.2)
        return real(self, *question)

    monkeypatch.setattr(Services, "locate", busy_twice)
    assert main(["relocalize", str(photo), "--connect", served]) == 0
    assert len(asked) == 3
    monkeypatch.setattr(Services, "locate", lambda *_: (_ for _ in ()).throw(Busy(60.0)))
    assert main(["relocalize", str(photo), "--connect", served]) == 1
    assert "the map server is busy, retry after 60.0 s" in capfd.readouterr().err


def test_matches_that_agree_are_explained_by_the_pose(node: Node):
    """By hand, match by match; a pose that is wrong explains next to nothing."""
    view = view_of(picture(MOVED))
    overlay = Overlay.of(node, view, MOVED)
    assert overlay.agreeing.sum() > 20
    for (a, b), agrees in zip(overlay.pairs, overlay.agreeing, strict=True):
        x, y, z = node.points_in_robot[a]
        there = MOVED.inverse().apply(np.array([[x, y, z]]))[0]
        u = CAMERA.cx - CAMERA.fx * there[1] / there[0]
        v = CAMERA.cy - CAMERA.fy * (there[2] - 0.3) / there[0]
        assert agrees == (np.hypot(*(view.pixels[b] - (u, v))) <= AGREES_PX)
    wrong = Overlay.of(node, view, Pose2(-1.0, 0.8, -0.3))
    assert wrong.agreeing.sum() < 0.1 * len(wrong.pairs)


def test_wide_images_are_stacked(node: Node, tmp_path):
    view = view_of(picture(MOVED))
    wide = Camera(640, 240, 277.0, 277.0, 319.5, 119.5, mount_height=0.3)
    moved = View(view.pixels + np.array([160, 0], np.float32), view.codes, wide)
    image = np.full((240, 640), 90, np.uint8)
    broad = Node(node.id, 0, node.map_from_robot, wide, node.landmarks)
    draw_matches(tmp_path / "wide.png", image, Lens(wide), broad, moved, MOVED)
    drawn = cv2.imread(str(tmp_path / "wide.png"))
    assert drawn.shape[1] == 2 * 640
    assert drawn.shape[0] > 4 * 240
