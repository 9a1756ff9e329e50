"""Merging on a recording that is made here: a drive past photographs, cut into robots."""

import csv
import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import HybridMap, MapId, Pose2, read_map_file
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.global_localization import resumption
from mapweave.agent.global_localization.resumption import TO_MAP
from mapweave.agent.settings import AgentSettings
from mapweave.cli import main
from mapweave.evaluation.merging import changes
from mapweave.evaluation.pieces import OVERLAP, cut
from mapweave.sim.camera import WEBCAM
from mapweave.sim.renderer import Renderer
from mapweave.sim.scene import Scene
from mapweave.sim.world import PanelSet
from mapweave.sim.worlds.catalog import make_world
from tests.recordings import steps, write_folder


def poses(count: int) -> list[Pose2]:
    """Ahead through the corridor of an office, weaving a little, 3 cm an image."""
    return [Pose2(0.7 + 0.03 * k, 0.1 * np.sin(0.05 * k), 0.15 * np.cos(0.05 * k)) for k in range(count)]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk that is long enough for two robots' maps."""
    return recorded(tmp_path_factory.mktemp("recordings") / "office walk", 150)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of it."""
    return recorded(tmp_path_factory.mktemp("recordings") / "office walk", 24)


def recorded(folder: Path, count: int) -> Path:
    """Images by the simulator's renderer, odometry that is 1 % too long, truth, two robots in splits.toml."""
    world = make_world("office", 5)
    corridor = next(room for room in world.plan.rooms if "corridor" in room.name)
    middle = Pose2(float(corridor.corners[:, 0].min()), float(corridor.corners[:, 1].mean()), 0.0)
    way = [middle @ pose for pose in poses(count)]
    renderer, scene = Renderer(WEBCAM, world.background), Scene([PanelSet.of(world.panels)])
    rng = np.random.default_rng(1)

    def seen(pose: Pose2) -> np.ndarray:
        turn = np.eye(3)
        turn[:2, :2] = pose.rotation
        image = renderer.render(scene, turn, np.array([pose.x, pose.y, 0.0])).astype(float)
        return np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)

    write_folder(folder, map(seen, way), steps(way, 1.01), timed=True, truth=way)
    (folder / "splits.toml").write_text(
        f'[[robot]]\nname = "One"\nfirst = 0\nlast = {2 * count // 3 - 1}\n'
        f'[[robot]]\nname = "two"\nfirst = {count // 3}\nlast = {count - 1}\n'
    )
    return folder


def evaluate(folder: Path, out: Path, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, object]:
    assert main(["eval", "merge", str(folder), "--out", str(out), "--json", *more]) == 0
    report: dict[str, object] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return report


@pytest.mark.slow
def test_two_robots_of_one_walk_become_one_map(recording: Path, tmp_path, capsys):
    report = evaluate(recording, tmp_path / "out", capsys)
    assert report["robots"] == {"one": 100, "two": 100} and report["truth"] is True
    assert report["components"] == 1 and int(str(report["links"])) >= 2
    assert report["false_links"] == 0 and report["link_precision"] == 1.0
    assert float(str(report["merged_ate_m"])) < 0.1
    content = read_map_file(tmp_path / "out" / "merged.mapweave")
    assert {node.agent for node in content.poses} == {"one", "two"}
    picture = cv2.imread(str(tmp_path / "out" / "map.png"))
    assert picture is not None and picture.std() > 5.0
    with (tmp_path / "out" / "links.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["kept"] == "yes" for row in rows) == report["links"]


@pytest.mark.slow
def test_a_robot_that_cannot_localize_begins_another_map(recording: Path, tmp_path, monkeypatch):
    """After 60 images it stands in a world upside down, which it then drives through."""
    folder = tmp_path / "carried off"
    images = [cv2.imread(str(recording / "images" / f"{k}.png"), cv2.IMREAD_GRAYSCALE) for k in range(150)]
    shown = images[:60] + [np.flipud(images[60])] * 45 + [np.flipud(image) for image in images[60:]]
    write_folder(folder, shown)
    rows = (recording / "odometry.csv").read_text().splitlines()
    (folder / "odometry.csv").write_text("\n".join(rows[:61] + ["0,0"] * 46 + rows[62:]) + "\n")
    monkeypatch.setattr(resumption, "TO_MAP", replace(TO_MAP, carried_views=3, carried_pause=0.1))
    made = [change for some in changes("one", Replay(folder), AgentSettings()) for change in some]
    maps = {epoch: [c for c in made if c.map == MapId("one", epoch)] for epoch in (1, 2)}
    assert len(maps[1]) + len(maps[2]) == len(made)
    for hybrid_map in maps.values():
        assert [change.sequence for change in hybrid_map] == list(range(1, len(hybrid_map) + 1))
        assert len(HybridMap([change.body for change in hybrid_map]).nodes) >= 1


@pytest.mark.slow
def test_without_truth_nothing_is_scored_and_pieces_can_be_chosen(recording: Path, tmp_path, capsys):
    bare = tmp_path / "bare"
    shutil.copytree(recording, bare)
    for name in ("truth.csv", "splits.toml"):
        (bare / name).unlink()
    report = evaluate(bare, tmp_path / "out", capsys, "--robots", "2")
    assert list(report["robots"]) == ["r0", "r1"]  # type: ignore[call-overload]
    assert report["truth"] is False and report["merged_ate_m"] is None and report["false_links"] is None
    assert int(str(report["nodes"])) >= 4


@pytest.mark.parametrize("robots", [2, 3, 5])
def test_pieces_overlap_and_no_image_is_in_two(robots: int):
    cuts = cut(1000, robots)
    assert cuts[0].start == 0 and cuts[-1][-1] >= 998
    for first, second in pairwise(cuts):
        assert not set(first) & set(second)
        shared = first[-1] - second[0]
        assert shared == pytest.approx(OVERLAP * (first[-1] - first[0]), abs=4)


@pytest.mark.parametrize(
    ("break_it", "more", "words"),
    [
        (lambda folder: shutil.rmtree(folder), (), "no such folder"),
        (lambda folder: (folder / "splits.toml").unlink(), (), "give --robots"),
        (lambda folder: (folder / "odometry.csv").unlink(), (), "no odometry: give --odometry FILE"),
        (lambda folder: (folder / "camera.toml").unlink(), (), "it must give the camera's intrinsics"),
        (lambda folder: shutil.rmtree(folder / "images"), ("--robots", "2"), "no images"),
        (lambda folder: (folder / "splits.toml").write_text("robot = 5"), (), "write a [[robot]] table"),
        (lambda folder: (folder / "truth.csv").write_text("x\n1\n"), (), "no column"),
        (
            lambda folder: (folder / "splits.toml").write_text('[[robot]]\nname="a"\nfirst=0\nlast=9\n'),
            (), "two robots or more",
        ),
        (
            lambda folder: (folder / "splits.toml").write_text(
                '[[robot]]\nname="a"\nfirst=0\nlast=9\n[[robot]]\nname="A"\nfirst=0\nlast=9\n'
            ),
            (), "two robots have the same name",
        ),
        (lambda folder: None, ("--robots", "1"), "use 2 to"),
        (lambda folder: None, ("--robots", "20"), "too few"),
    ],
)  # fmt: skip
def test_an_unusable_recording_is_reported_in_one_line(
    short: Path, tmp_path, capsys, break_it, more: tuple[str, ...], words: str
):
    folder = tmp_path / "broken"
    shutil.copytree(short, folder)
    break_it(folder)
    assert main(["eval", "merge", str(folder), "--out", str(tmp_path / "out"), *more]) == 1
    output = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mapweave: ")]
    assert len(output) == 1 and words in output[0]
    assert not (tmp_path / "out").exists()


def test_an_image_that_cannot_be_read_is_named(short: Path, tmp_path, capsys):
    folder = Path(shutil.copytree(short, tmp_path / "spoilt"))
    image = sorted((folder / "images").iterdir())[3]
    image.write_bytes(image.read_bytes()[:200])
    assert main(["eval", "merge", str(folder), "--out", str(tmp_path / "out"), "--json"]) == 0
    said = capsys.readouterr().err
    assert f"{image.name}: not an image" in said and "(left out, 1 of " in said
