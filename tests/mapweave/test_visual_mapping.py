"""Videos without odometry: a simulated walk with known truth becomes a map up to scale, always the same."""

import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import Certainty, Edge, Node, Pose2, read_map_file, relocalizer_of, view_of
from mapweave.cli import main
from mapweave.evaluation.visual_replaying import NO_MAP
from mapweave.exit_status import USAGE
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.sim.camera import CAMERAS
from mapweave.sim.photographer import walk
from mapweave.sim.worlds.catalog import world_from_table
from tests.mapweave.command_line import complaint
from tests.recordings import camera_toml, write_folder, write_video

COUNT, SPACING, RATE, PHONE = 30, 0.1, 10.0, CAMERAS["phone"]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Pose2]]:
    """A walk around a bend as a video, with its camera beside it, and where each frame was taken."""
    folder = tmp_path_factory.mktemp("video")
    world = world_from_table({"kind": "office", "rooms": 2}, 4, Path())
    taken = walk(world, PHONE, COUNT, SPACING, 4)
    write_video(folder / "walk.avi", [photograph.image for photograph in taken], RATE)
    (folder / "camera.toml").write_text(camera_toml(PHONE.intrinsics, PHONE.distortion))
    return folder / "walk.avi", [photograph.world_from_camera for photograph in taken]


def frames(path: Path) -> list[np.ndarray]:
    capture, out = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        out.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return out


def replayed(path: Path, camera: Path, data: Path, status: int = 0) -> list[Path]:
    """The map files that a replay writes."""
    arguments = ["replay", path, "--camera", camera, "--offline", "--epoch", 1, "--data", data]
    assert main([str(argument) for argument in arguments]) == status
    return sorted(data.glob("*.mapweave"))


def contents(path: Path) -> tuple[list[Node], list[Edge]]:
    changes = read_map_file(path).changes
    nodes = [change.node for change in changes if isinstance(change, NodePut)]
    return nodes, [change.edge for change in changes if isinstance(change, EdgePut)]


@pytest.fixture(scope="module")
def made(video: tuple[Path, list[Pose2]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the walk."""
    path, _ = video
    (file,) = replayed(path, path.with_name("camera.toml"), tmp_path_factory.mktemp("map"))
    return file


def test_a_video_becomes_one_map_that_is_right_up_to_one_scale(video, made: Path):
    _, truth = video
    nodes, edges = contents(made)
    assert len(nodes) > 6, "more than one window"
    assert [(edge.a, edge.b) for edge in edges] == [(a.id, b.id) for a, b in pairwise(nodes)]
    at = [truth[round(node.stamp_ns * RATE / 1e9)] for node in nodes]
    steps = [a.distance(b) for a, b in pairwise(at)]
    mapped = [float(np.hypot(e.a_from_b.mean.x, e.a_from_b.mean.y)) for e in edges]
    ratios = np.array(steps) / np.array(mapped)
    assert np.abs(ratios / np.median(ratios) - 1.0).max() < 0.15, "one scale goes through"
    turns = [(a.inverse() @ b).heading for a, b in pairwise(at)]
    assert np.abs(np.array(turns) - [edge.a_from_b.mean.heading for edge in edges]).max() < 0.05
    assert all(edge.evidence["shared"] == len(edge.shared) >= 12 for edge in edges)


def test_the_trajectory_has_every_image_as_exactly_as_the_keyframes(video, made: Path):
    """Only the keyframes were written."""
    _, truth = video
    lines = made.with_suffix(".tum").read_text().splitlines()
    assert not [line for line in lines if line.startswith("#")], "all are found, none is interpolated"
    rows = np.array([line.split() for line in lines], float)
    assert rows[:, 0] == pytest.approx(np.arange(COUNT) / RATE)
    true = np.array([pose.vector for pose in truth])
    mine, there = rows[:, 1] + 1j * rows[:, 2], true[:, 0] + 1j * true[:, 1]
    mine, there = mine - mine.mean(), there - there.mean()
    # The similarity that brings the one nearest to the other.
    fit = (mine.conj() @ there) / (mine.conj() @ mine)
    off = np.abs(fit * mine - there)
    assert off.max() < 0.04, "on a walk of 3 m"
    turned = 2 * np.arctan2(rows[:, 6], rows[:, 7]) - true[:, 2]
    turned -= turned[0]
    assert np.abs((turned + np.pi) % (2 * np.pi) - np.pi).max() < 0.03


def test_rerun_and_a_robot_that_is_not_there_are_refused(video, tmp_path, capfd):
    """Both were ignored."""
    path, _ = video
    command = ["replay", path, "--camera", path.with_name("camera.toml"), "--offline", "--data", tmp_path]
    assert "leave it out" in complaint(capfd, *command, "--rerun", tmp_path / "x.rrd", status=USAGE)
    said = complaint(capfd, *command, "--robot", "a")
    assert "splits.toml" in said and not list(tmp_path.iterdir())


def test_a_lost_robot_gets_the_place_but_not_the_distance(video, made: Path):
    path, truth = video
    relocalizer, (nodes, _) = relocalizer_of(read_map_file(made)), contents(made)
    where = {node.id: truth[round(node.stamp_ns * RATE / 1e9)] for node in nodes}
    way, mapped = (
        sum(a.distance(b) for a, b in pairwise(poses))
        for poses in (list(where.values()), [node.map_from_robot.mean for node in nodes])
    )
    errors = []
    for k, image in list(enumerate(frames(path)))[::3]:
        answer = relocalizer.answer(view_of(image, PHONE.intrinsics, PHONE.distortion))
        if answer.certainty is Certainty.PLACE:
            place = answer.candidates[0]
            found = place.node_from_robot.mean
            scaled = Pose2(found.x * way / mapped, found.y * way / mapped, found.heading)
            errors.append((where[place.node] @ scaled).distance(truth[k]))
            assert not place.distance_known
        assert answer.certainty is not Certainty.FOUND
    assert len(errors) > 0.7 * COUNT / 3
    assert np.median(errors) < 0.15 and max(errors) < 0.8, "right but for the scale"


@pytest.mark.slow
def test_the_same_video_gives_the_same_map(video, made: Path, tmp_path):
    path, _ = video
    (again,) = replayed(path, path.with_name("camera.toml"), tmp_path)
    assert again.read_bytes() == made.read_bytes()


@pytest.mark.slow
def test_a_cut_and_a_turn_on_the_spot_begin_another_map(video, tmp_path):
    """The second half is mirrored; between the halves the camera turns by 60 degrees, by homographies."""
    path, _ = video
    images, c = frames(path), PHONE.intrinsics
    matrix = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
    turns = [
        matrix @ cv2.Rodrigues(np.array([0.0, 0.105 * k, 0.0]))[0] @ np.linalg.inv(matrix) for k in range(10)
    ]
    turning = [cv2.warpPerspective(images[14], turn, (c.width, c.height)) for turn in turns]
    write_video(
        tmp_path / "cut.avi", [*images[:15], *turning, *(image[:, ::-1] for image in images[15:])], RATE
    )
    files = replayed(tmp_path / "cut.avi", path.with_name("camera.toml"), tmp_path / "maps")
    assert [file.name for file in files] == ["cut.1.mapweave", "cut.2.mapweave"]
    first, second = (contents(file)[0] for file in files)
    assert first[-1].stamp_ns < 2.5e9 <= second[0].stamp_ns


@pytest.mark.slow
def test_a_folder_of_images_without_odometry_is_mapped_as_the_video_is(made, video, tmp_path):
    path, _ = video
    folder = tmp_path / "walk"
    write_folder(folder, frames(path))
    (folder / "camera.toml").unlink()
    (file,) = replayed(folder, path.with_name("camera.toml"), tmp_path / "maps")
    nodes, _ = contents(file)
    assert [node.stamp_ns for node in nodes] == [node.stamp_ns for node in contents(made)[0]]
    assert len(np.loadtxt(file.with_suffix(".tum"))) == COUNT


def test_info_says_what_is_missing_and_damage_is_said(video, tmp_path, capfd):
    path, _ = video
    camera = path.with_name("camera.toml")
    assert main(["info", str(path), "--camera", str(camera), "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert facts["images"] == COUNT and facts["driven_m"] is None
    assert "no scale" in facts["missing"][0]
    blank = tmp_path / "blank.avi"
    write_video(blank, [np.full((240, 320), 90, np.uint8)] * 10, RATE)
    replayed(blank, camera, tmp_path / "none", status=1)
    output = capfd.readouterr().err.splitlines()
    assert output[-1].startswith(f"mapweave: {blank}: no two of its") and "Traceback" not in output


def test_an_evaluation_says_what_is_used_and_the_error_up_to_scale(video, tmp_path, capfd):
    """It refused recordings without odometry."""
    path, truth = video
    (tmp_path / "truth.csv").write_text(
        "stamp_s,x_m,y_m,heading_rad\n"
        + "".join(f"{k / RATE},{3 * p.x},{3 * p.y},{p.heading}\n" for k, p in enumerate(truth))
    )
    arguments = ["eval", "replay", path, "--camera", path.with_name("camera.toml"), "--out", tmp_path / "out"]
    given = ["--truth", tmp_path / "truth.csv", "--json"]
    assert main([str(one) for one in (*arguments, *given)]) == 0
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert (report["frames"], report["frames_used"], report["not_used"]) == (COUNT, 1.0, {})
    assert report["maps"] == 1 and report["nodes"] == report["edges"] + 1 and report["bytes"] > 1000
    assert 0.0 < report["ate_up_to_scale_m"] < 0.06, "on a walk of 9 m"
    assert len(np.loadtxt(tmp_path / "out" / "map0.tum")) == COUNT
    assert main([str(one) for one in arguments]) == 0
    lines = capfd.readouterr().out
    assert "frames_used" in lines and "100 %" in lines and "unknown" in lines, "nothing is scored"


def test_an_evaluation_counts_images_that_no_map_has(video, tmp_path, capfd):
    path, _ = video
    grey = [np.full((240, 320), 90, np.uint8)] * 6
    write_video(tmp_path / "walk.avi", [*frames(path)[:12], *grey], RATE)
    arguments = ["eval", "replay", tmp_path / "walk.avi", "--camera", path.with_name("camera.toml"), "--json"]
    assert main([str(one) for one in (*arguments, "--out", tmp_path / "out")]) == 0
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert report["frames"] == 18 and report["not_used"] == {NO_MAP: 6} and not report["truth"]
    assert report["frames_used"] == round(12 / 18, 4) and report["ate_up_to_scale_m"] is None
