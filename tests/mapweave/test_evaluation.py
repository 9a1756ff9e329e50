"""Recognition on recordings: small ones are made here, of photographs, with known truth."""

import csv
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data

from mapweave import Camera, NodeId, Pose2, PoseGaussian
from mapweave.cli import main
from mapweave.evaluation.asking_again import Asked, trial_figures, trials_of
from mapweave.evaluation.photographs import evidence
from mapweave.evaluation.verdict import JudgedAnswer, figures
from mapweave.hybridmap.query import NO_COMPONENT, Certainty, RelocalizeAnswer, Whereabouts
from tests.photo_walls import rendered, two_walls
from tests.recordings import camera_toml, steps, write_folder

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)


def render(world_from_robot: Pose2, camera: Camera = CAMERA) -> np.ndarray:
    """Two photographs, 2.2 m and 3.2 m from the origin."""
    return rendered(two_walls(), camera, world_from_robot)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One robot drives ahead; another one later, next to it, then faces a blank wall behind."""
    folder = tmp_path_factory.mktemp("recordings") / "drive"
    return recorded(folder, render, camera_toml())


SMALL = Camera(160, 120, 138.5, 138.5, 79.5, 59.5, mount_height=0.3)
WIDE = Camera(500, 400, 150.0, 150.0, 250.0, 200.0, mount_height=0.3)
FISHEYE_TOML = (
    "width = 320\nheight = 240\nfx = 130.0\nfy = 130.5\ncx = 158.6\ncy = 120.9\nheight_m = 0.3\n"
    'lens = "equidistant"\ndistortion = [-0.02, 0.004, -0.003, 0.0005]\n'
)


def seen_by_fisheye(world_from_robot: Pose2) -> np.ndarray:
    """The same walls through a fisheye lens of 140 degrees, by OpenCV's model."""
    matrix = np.array([[130.0, 0, 158.6], [0, 130.5, 120.9], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 1, 2)
    rays = cv2.fisheye.undistortPoints(pixels, matrix, np.array([-0.02, 0.004, -0.003, 0.0005]))
    at = np.clip(rays.reshape(240, 320, 2) * WIDE.fx + [WIDE.cx, WIDE.cy], -1.0, 1e4).astype(np.float32)
    return cv2.remap(render(world_from_robot, WIDE), at, None, cv2.INTER_LINEAR, borderValue=128)


def recorded(folder: Path, see: Callable[[Pose2], np.ndarray], camera: str) -> Path:
    first = [Pose2(0.03 * k, 0.0, 0.0) for k in range(36)]
    second = [Pose2(0.1 + 0.09 * k, 0.06, 0.02) for k in range(9)] + [Pose2(0.5, 0.0, math.pi)] * 3
    way = first + second
    write_folder(folder, map(see, way), steps(way), camera, timed=True, truth=way)
    (folder / "splits.toml").write_text(
        '[[robot]]\nname = "a"\nfirst = 0\nlast = 35\n[[robot]]\nname = "b"\nfirst = 36\nlast = 47\n'
    )
    return folder


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Photographs of three places, the same ones taken again from elsewhere, and one of nothing known."""
    folder = tmp_path / "walk"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(2)
    scenes = [skimage.data.coffee(), skimage.data.astronaut(), skimage.data.chelsea()]
    for number, scene in enumerate(scenes, 1):
        grey = cv2.resize(cv2.cvtColor(scene, cv2.COLOR_RGB2GRAY), (320, 240))
        cv2.imwrite(str(folder / "images" / f"img{number}.png"), grey)
        corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], np.float32)
        moved = corners + rng.uniform(-18, 18, (4, 2)).astype(np.float32)
        warped = cv2.warpPerspective(grey, cv2.getPerspectiveTransform(corners, moved), (320, 240))
        cv2.imwrite(str(folder / "images" / f"img{number + 10}.png"), warped)
    unknown = cv2.resize(rng.integers(0, 255, (60, 80)).astype(np.uint8), (320, 240))
    cv2.imwrite(str(folder / "images" / "img14.png"), unknown)
    (folder / "lap_truth.csv").write_text(
        "query,ref_best,ref_lo,ref_hi,note\n11,1,1,1,\n12,2,2,2,\n13,3,3,3,\n14,,,,nothing known\n"
    )
    return folder


def report(capfd: pytest.CaptureFixture[str], *arguments: object) -> dict:
    assert main(["eval", "relocalize", *map(str, arguments), "--json"]) == 0
    return json.loads(capfd.readouterr().out.strip().splitlines()[-1])


def test_a_drive(drive: Path, capfd, tmp_path):
    values = report(capfd, drive, "--out", tmp_path / "out")
    assert (values["queries"], values["expected"]) == (12, 9)
    assert values["nodes"] >= 1
    assert values["recall_at_1"] >= 0.8
    assert (values["precision"], values["false_accept"]) == (1.0, 0.0)
    assert values["recall_within_2m"] >= values["recall_at_1"]
    assert (values["found_wrong"], values["decided_wrong"], values["decided_precision"]) == (0, 0, 1.0)
    assert values["error_m_median"] < 0.1
    assert values["error_deg_median"] < 1.0
    with (tmp_path / "out" / "answers-depths.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12
    assert [row["certainty"] for row in rows[-3:]] == ["unknown"] * 3


def test_a_map_that_is_there_is_asked(drive: Path, capfd, tmp_path):
    """The journal of one robot, asked by the other."""
    arguments = ["replay", str(drive), "--robot", "a", "--offline", "--data", str(tmp_path), "--epoch", "1"]
    assert main(arguments) == 0
    capfd.readouterr()
    values = report(capfd, drive, "--map", tmp_path / "a.sqlite", "--robot", "b")
    assert (values["queries"], values["expected"]) == (12, 9) and values["nodes"] >= 1
    assert (values["precision"], values["false_accept"]) == (1.0, 0.0)
    assert values["recall_at_1"] >= 0.8 and values["error_m_median"] < 0.1


@pytest.mark.parametrize(("see", "camera_toml"), [
    pytest.param(lambda pose: render(pose, SMALL), camera_toml(SMALL), id="160x120", marks=pytest.mark.slow),
    pytest.param(seen_by_fisheye, FISHEYE_TOML, id="fisheye", marks=pytest.mark.slow),
])  # fmt: skip
def test_other_cameras_map_and_recognise_the_same_drive(see, camera_toml: str, capfd, tmp_path):
    folder = recorded(tmp_path / "drive", see, camera_toml)
    values = report(capfd, folder)
    assert values["recall_at_1"] >= 0.8
    assert (values["precision"], values["false_accept"]) == (1.0, 0.0)
    assert values["error_m_median"] < 0.1
    assert values["error_deg_median"] < 1.0
    (folder / "splits.toml").unlink()
    for name in ("odometry.csv", "truth.csv", "times.txt"):
        kept = (folder / name).read_text().splitlines()[: 36 + (name != "times.txt")]
        (folder / name).write_text("\n".join(kept) + "\n")
    for image in folder.glob("images/*.png"):
        if int(image.stem) >= 36:
            image.unlink()
    assert main(["eval", "replay", str(folder), "--json"]) == 0
    values = json.loads(capfd.readouterr().out.strip().splitlines()[-1])
    assert values["frames_used"] == 1.0
    assert values["ate_m"] < 0.02


@pytest.mark.slow
def test_a_drives_error_is_measured_against_its_truth(drive: Path, capfd, tmp_path):
    """The asking robot's truth is moved by 7 m: so are all errors, and nothing is right any more."""
    folder = Path(shutil.copytree(drive, tmp_path / "moved"))
    rows = (folder / "truth.csv").read_text().splitlines()
    moved = rows[:37]
    for row in rows[37:]:
        stamp, x, y, heading = row.split(",")
        moved.append(f"{stamp},{x},{float(y) + 7.0},{heading}")
    (folder / "truth.csv").write_text("\n".join(moved) + "\n")
    values = report(capfd, folder)
    assert values["error_m_median"] == pytest.approx(7.0, abs=0.2)
    assert (values["expected"], values["recall_at_1"], values["precision"]) == (0, None, 0.0)
    assert values["false_accept"] > 0.5
    (folder / "truth.csv").unlink()
    values = report(capfd, folder)
    assert (values["truth"], values["precision"], values["false_accept"]) == (False, None, None)
    assert values["found"] >= 7


def test_photographs(walk: Path, capfd, tmp_path):
    values = report(capfd, walk, "--focal", 300, "--out", tmp_path / "out")
    assert (values["queries"], values["expected"], values["nodes"]) == (4, 3, 3)
    assert (values["recall_at_1"], values["precision"], values["unknown_share"]) == (1.0, 1.0, 0.25)
    assert (values["error_frames_median"], values["false_accept"]) == (0.0, 0.0)
    assert (values["recall_within_2m"], values["decided"]) == (1.0, 3), "the last one is followed by nothing"
    assert (tmp_path / "out" / "answers-looks.csv").exists()
    # Two references changed over: what was right is wrong.
    table = (walk / "lap_truth.csv").read_text()
    (walk / "lap_truth.csv").write_text(table.replace("11,1,1,1", "11,2,2,2").replace("12,2,2,2", "12,1,1,1"))
    (walk / "camera.toml").write_text(camera_toml())
    values = report(capfd, walk)
    assert (values["recall_at_1"], values["precision"]) == (pytest.approx(1 / 3, abs=1e-4),) * 2


@pytest.mark.parametrize("step", [1, 5])
def test_photographs_are_numbered_in_any_step(step: int, capfd, tmp_path):
    """A scene that two places in a row show is one place; if a place far from it shows it too, it is two."""
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(4)
    scenes = {"a": skimage.data.coffee(), "b": skimage.data.astronaut(), "c": skimage.data.chelsea()}
    for number, name in enumerate("aabbccccbabcb", 1):
        grey = cv2.resize(cv2.cvtColor(scenes[name], cv2.COLOR_RGB2GRAY), (320, 240))
        corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], np.float32)
        moved = corners + rng.uniform(-9, 9, (4, 2)).astype(np.float32)
        seen = cv2.warpPerspective(grey, cv2.getPerspectiveTransform(corners, moved), (320, 240))
        cv2.imwrite(str(tmp_path / "images" / f"{step * number:04d}.png"), seen)
    # Places 1 to 9; scene b is at 3, 4 and 9. Questions 10 to 13.
    rows = [(10, 1, 1, 2), (11, 3, 3, 4), (12, 5, 5, 8), (13, 3, 3, 4)]
    lines = "".join(",".join(str(step * value) for value in row) + ",\n" for row in rows)
    (tmp_path / "lap_truth.csv").write_text("query,ref_best,ref_lo,ref_hi,note\n" + lines)
    values = report(capfd, tmp_path, "--focal", 300, "--out", tmp_path / "out")
    with (tmp_path / "out" / "answers-looks.csv").open() as file:
        answers = [row["certainty"] for row in csv.DictReader(file)]
    assert answers == ["found", "ambiguous", "found", "ambiguous"]
    assert (values["precision"], values["recall_at_1"]) == (1.0, 0.5)
    assert values["recall_within_2m"] == 0.75, "the one after the second is found"


def test_figures_by_hand():
    result, unknown, ambiguous = Certainty.FOUND, Certainty.UNKNOWN, Certainty.AMBIGUOUS
    verdicts = [
        JudgedAnswer("1", True, result, "a", True, True, error_m=0.2, error_deg=1.0, answer_ms=10.0),
        JudgedAnswer("2", True, result, "a", True, True, error_m=0.4, error_deg=3.0, answer_ms=20.0),
        JudgedAnswer("3", True, result, "b", False, False, error_m=9.0, error_deg=3.0, answer_ms=30.0),
        JudgedAnswer("4", True, unknown, first=True),
        JudgedAnswer("5", True, ambiguous, "a", True, True),
        JudgedAnswer("6", False, result, "a", False, False, error_m=30.0, error_deg=90.0),
        JudgedAnswer("7", False, unknown, first=False),
        JudgedAnswer("8", None, result, "a"),
    ]
    outcome = figures(verdicts)
    assert (outcome["queries"], outcome["expected"], outcome["found"]) == (8, 5, 5)
    assert (outcome["recall_at_1"], outcome["retrieved_at_1"], outcome["precision"]) == (0.4, 0.8, 0.5)
    assert (outcome["unknown_share"], outcome["ambiguous_share"], outcome["false_accept"]) == (
        0.25,
        0.125,
        0.5,
    )
    assert (outcome["recall_0.25m_2deg"], outcome["recall_0.5m_5deg"], outcome["recall_5m_10deg"]) == (
        0.2,
        0.4,
        0.4,
    )
    assert outcome["error_m_median"] == 4.7
    assert outcome["answer_ms_p50"] == 20.0
    assert "error_frames_median" not in outcome


def test_a_robot_asks_again_until_it_knows_or_has_driven_two_metres():
    """Answers every metre: found at 3 m, rightly, and at 6 m, wrongly; nothing is certain elsewhere."""
    node, here = NodeId("r0", 1, 1), PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
    place = Whereabouts(node, here, None, NO_COMPONENT, 30, 0.9)
    nothing = RelocalizeAnswer(Certainty.UNKNOWN, (), "")
    found = RelocalizeAnswer(Certainty.FOUND, (place,), "")
    asked = [
        Asked(found if k in (3, 6) else nothing, Pose2(float(k), 0, 0), float(k), 0.0, expected=k < 5)
        for k in range(8)
    ]
    trials = trials_of(asked, lambda k, given: k == 3)
    assert [trial.decided for trial in trials] == [False, True, True, True, True, True, True, False]
    assert [trial.right for trial in trials] == [None, True, True, True, False, False, False, None]
    outcome = trial_figures(trials)
    assert outcome == {
        "recall_within_2m": 0.6, "decided": 6, "decided_wrong": 3, "decided_precision": 0.5,
    }  # fmt: skip


def test_evidence_bounds_chance():
    """Chernoff's bound is above the exact binomial tail, and not by much in its exponent."""
    for inliers, matches in ((12, 20), (20, 25), (30, 60)):
        k, n, p = inliers - 7, matches - 7, 4.0 / 384
        exact = sum(math.comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k, n + 1))
        bound = math.exp(-(evidence(inliers, matches, 2.0, 384) + math.log(2000)))
        assert exact <= bound
        assert math.log(bound) < 0.75 * math.log(exact)
    assert evidence(7, 50, 2.0, 384) == 0.0
    assert evidence(5, 6, 2.0, 384) == 0.0


def complaint(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["eval", "relocalize", *map(str, arguments)]) == 1
    output = [line for line in capfd.readouterr().err.splitlines() if line.startswith("mapweave: ")]
    assert len(output) == 1
    return output[0]


def test_folders_that_are_none(walk: Path, capfd, tmp_path):
    assert "no such folder" in complaint(capfd, tmp_path / "nothing")
    assert "two passes cannot be told apart" in complaint(capfd, tmp_path)
    assert "camera.toml: no such file" in complaint(capfd, walk)
    assert "focal lengths must be positive" in complaint(capfd, walk, "--focal", -3)
    assert "not both" in complaint(capfd, walk, "--focal", 300, "--camera", walk / "camera.toml")
    table = walk / "lap_truth.csv"
    for content, words in (
        ("", "no questions in it"),
        ("query\n1\n", "no column 'ref_best'"),
        ("query,ref_best,ref_lo,ref_hi\n11,1,x,1\n", "invalid literal"),
        ("query,ref_best,ref_lo,ref_hi\n99,1,1,1\n", "there is no image 99"),
        (
            "query,ref_best,ref_lo,ref_hi\n" + "".join(f"{n},,,\n" for n in (1, 2, 3, 11, 12, 13, 14)),
            "first pass",
        ),
    ):
        table.write_text(content)
        assert words in complaint(capfd, walk, "--focal", 300)
    table.write_text("query,ref_best,ref_lo,ref_hi\n11,1,1,1\n")
    (walk / "images" / "img2.png").write_text("no image")
    assert "not an image" in complaint(capfd, walk, "--focal", 300)


def test_drives_that_are_none(drive: Path, capfd, tmp_path):
    folder = Path(shutil.copytree(drive, tmp_path / "spoilt"))
    assert "leave --camera and --focal out" in complaint(capfd, folder, "--focal", 300)
    (folder / "truth.csv").write_text("stamp_s,x_m\n0,0\n")
    assert "no column 'y_m'" in complaint(capfd, folder)
    (folder / "truth.csv").write_text("stamp_s,x_m,y_m,heading_rad\n1,0,0,0\n1,0,0,0\n")
    assert "stamps must ascend" in complaint(capfd, folder)
    (folder / "splits.toml").write_text('[[robot]]\nname = "a"\nfirst = 0\nlast = 5\n')
    assert "there is only 1" in complaint(capfd, folder)
    (folder / "splits.toml").write_text("[[robot")
    assert "splits.toml" in complaint(capfd, folder)


def test_what_of_a_drive_cannot_be_read_is_said(drive: Path, capfd, tmp_path):
    """An image that is left out, once for each robot; and why so few images are left that none fits."""
    folder = Path(shutil.copytree(drive, tmp_path / "spoilt"))
    whole = (folder / "images" / "38.png").read_bytes()
    (folder / "images" / "38.png").write_bytes(whole[: len(whole) // 2])
    assert main(["eval", "relocalize", str(folder), "--json"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out.strip().splitlines()[-1])["queries"] == 11
    assert "38.png: not an image" in said.err and "(left out, 1 of 12 images)" in said.err
    assert said.err.count("left out") == 1
    lines = (folder / "odometry.csv").read_text().splitlines()
    lines[20] = "nan,0"
    (folder / "odometry.csv").write_text("\n".join(lines))
    words = complaint(capfd, folder)
    assert "frames 0 to 35 are not within the 19 images; " in words and "odometry.csv: line 21: " in words
