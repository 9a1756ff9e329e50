"""A map of photographs: from pictures of a simulated room with known truth, and by the command."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import Certainty, HybridMap, MapId, Pose2, read_camera, read_grey, relocalizer_of, view_of
from mapweave.cli import main
from mapweave.exit_status import FAILED, USAGE
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.photographs import SCALE_SHARE, map_of_photographs
from mapweave.sim.camera import CAMERAS
from mapweave.sim.photographer import walk
from mapweave.sim.worlds.catalog import world_from_table
from mapweave.storage.map_file import MapFile, read_map_file
from mapweave.wire.codec import encode_body
from tests.mapweave.command_line import complaint
from tests.recordings import camera_toml

COUNT, SPACING, PHONE = 6, 0.5, CAMERAS["phone"]


@pytest.fixture(scope="module")
def stretch(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Pose2]]:
    """A folder of photographs with their camera, and where they were taken."""
    folder = tmp_path_factory.mktemp("stretch")
    world = world_from_table({"kind": "office", "rooms": 2}, 4, Path())
    taken = walk(world, PHONE, COUNT, SPACING, 4)
    for number, place in enumerate(taken):
        assert cv2.imwrite(str(folder / f"{number}.png"), place.image)
    (folder / "camera.toml").write_text(camera_toml(PHONE.intrinsics, PHONE.distortion))
    return folder, [place.world_from_camera for place in taken]


def test_nodes_are_where_the_photographs_were_taken_up_to_scale(stretch):
    folder, truth = stretch
    images = [folder / f"{number}.png" for number in range(COUNT)]
    changes = map_of_photographs(images, PHONE.intrinsics, PHONE.distortion, SPACING, MapId("hall", 1))
    nodes = [change.node for change in changes if isinstance(change, NodePut)]
    edges = [change.edge for change in changes if isinstance(change, EdgePut)]
    assert [node.id.number for node in nodes] == list(range(1, COUNT + 1))
    assert [(edge.a.number, edge.b.number) for edge in edges] == [(k, k + 1) for k in range(1, COUNT)]
    last = truth[0].inverse() @ truth[-1]
    scale = math.hypot(nodes[-1].map_from_robot.mean.x, nodes[-1].map_from_robot.mean.y) / math.hypot(
        last.x, last.y
    )
    assert scale == pytest.approx(1.0, abs=SCALE_SHARE)
    for node, pose in zip(nodes, truth, strict=True):
        here, true = node.map_from_robot.mean, truth[0].inverse() @ pose
        assert math.hypot(here.x / scale - true.x, here.y / scale - true.y) < 0.04
        assert abs(here.heading - true.heading) < 0.02
        assert node.landmarks.scale_share == pytest.approx(SCALE_SHARE, rel=0.1)
        assert len(node.landmarks) >= 30
        assert len(encode_body(NodePut(node))) < 3000
    for edge in edges:
        a, b = (nodes[end.number - 1].landmarks for end in (edge.a, edge.b))
        assert len(edge.shared) >= 12
        # The same points look alike in both.
        assert np.median(np.abs(a.codes[edge.shared[:, 0]].astype(int) - b.codes[edge.shared[:, 1]])) < 12
        assert edge.a_from_b.covariance[0, 0] > (0.8 * SCALE_SHARE * edge.a_from_b.mean.x) ** 2


def test_a_map_file_says_where_a_photograph_was_taken(stretch):
    folder, _ = stretch
    images = [folder / f"{number}.png" for number in range(COUNT)]
    camera, distortion = read_camera(folder / "camera.toml")
    changes = map_of_photographs(images, camera, distortion, SPACING, MapId("hall", 1))
    relocalizer = relocalizer_of(MapFile("agent", "hall", tuple(changes)))
    view = view_of(read_grey(images[3]), camera, distortion)
    answer = relocalizer.answer(view)
    # The scale was never measured.
    assert answer.certainty is Certainty.PLACE, answer.reason
    assert answer.candidates[0].node.number == 4


def test_the_command_writes_a_map_file(stretch, tmp_path, capfd):
    folder, _ = stretch
    out = tmp_path / "hall.mapweave"
    assert main(["map", "from-photos", str(folder), "--spacing", "0.5", "-o", str(out), "--json"]) == 0
    values = json.loads(capfd.readouterr().out)
    read = HybridMap(read_map_file(out, "agent").changes)
    assert len(read.nodes) == COUNT
    assert values["landmarks"] == [len(node.landmarks) for node in read.nodes.values()]
    assert {str(node.map) for node in read.nodes} == {values["map"]}
    assert not list(tmp_path.glob("*.sqlite"))


def test_an_invalid_stretch_is_reported_in_one_line(stretch, tmp_path, capfd):
    folder, _ = stretch
    out = tmp_path / "hall.mapweave"

    def said(*arguments: object, status: int = FAILED) -> str:
        return complaint(capfd, "map", "from-photos", *arguments, "-o", out, status=status)

    assert "spacing" in said(folder, "--spacing", "0", status=USAGE)
    assert "spacing" in said(folder, "--spacing", "nan", status=USAGE)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "camera.toml" in said(empty, "--spacing", "0.5")
    (empty / "camera.toml").write_text((folder / "camera.toml").read_text())
    assert "no images" in said(empty, "--spacing", "0.5")
    cv2.imwrite(str(empty / "1.png"), np.full((240, 320), 90, np.uint8))
    assert "two photographs" in said(empty, "--spacing", "0.5")
    cv2.imwrite(str(empty / "2.png"), np.full((240, 320), 90, np.uint8))
    # By the names of the files: of IMG_0207.png and so on no one counts which is the second.
    assert "photographs 1.png and 2.png do not show the same" in said(empty, "--spacing", "0.5")
    (empty / "2.png").rename(empty / "17.png")
    assert "photographs 1.png and 17.png do not show the same" in said(empty, "--spacing", "0.5")
    assert "use 1 to 32" in said(folder, "--spacing", "0.5", "--name", "Hall", status=USAGE)
    assert not out.exists()


@pytest.mark.slow
def test_a_walk_is_repeatable_and_keeps_clear():
    world = world_from_table({"kind": "office", "rooms": 2}, 4, Path())
    first, again = (walk(world, PHONE, 4, 0.5, 9) for _ in range(2))
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.image, other.image)
        assert one.world_from_camera == other.world_from_camera
        assert world.plan.is_free(one.world_from_camera.x, one.world_from_camera.y, 0.15)
    with pytest.raises(InvalidValue, match="no free way"):
        walk(world, PHONE, 100, 2.0, 9)
