"""`mapweave calibrate camera`: images, a video or a live camera become settings that an agent reads."""

import json
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

import mapweave.agent.drivers.camera
from mapweave.agent.drivers.camera import StampedImage
from mapweave.agent.drivers.settings import Geometry
from mapweave.agent.drivers.settings_writer import camera_table, write_camera
from mapweave.cli import main
from mapweave.exit_status import NO, USAGE
from mapweave.hybridmap.errors import SettingsError
from mapweave.settings import load_settings
from mapweave.vision.calibration.target import CalibrationTarget
from mapweave.vision.calibration.target_pdf import target_pdf
from mapweave.vision.lens import Lens
from tests.mapweave.command_line import complaint
from tests.quick import first_quick
from tests.recordings import write_video
from tests.vision.calibration.boards import bitmap, drawn_view, pixels_of, read_page

SIZE = (320, 240)
PINHOLE = np.array([280.0, 281.0, 161.0, 119.0, -0.3, 0.12, 0.001, -0.0005, -0.02])
TARGET = CalibrationTarget(columns=6, rows=9, square=0.028, marker=0.022)
"""Larger markers than those of the default, for images of 320x240."""
OPTIONS = ["--squares", "6x9", "--square-mm", "28", "--marker-mm", "22"]
FISHEYE = np.array([115.0, 115.5, 158.7, 120.9, -0.02, 0.004, -0.003, 0.0005])


def poses(focal: float) -> Iterator[np.ndarray]:
    """Places over the whole image, near and far, each with another tilt."""
    tilts = [(0.0, 0.0), (0.6, 0.1), (-0.1, 0.65), (-0.6, 0.0), (0.2, -0.6), (0.4, 0.45), (-0.4, -0.4)]
    places = [(0, 0), (-1, -1), (1, -1), (1, 1), (-1, 1), (-1, 0), (1, 0), (0, -1), (0, 1)]
    for k in range(36):
        x, y = places[k % 9]
        turn = np.array([*tilts[k % 7], 0.15 * (k % 3 - 1)])
        rotation, _ = cv2.Rodrigues(turn)
        far = focal / SIZE[1] * (0.17, 0.22, 0.19, 0.26)[k // 9]
        reach = (0.4, 0.36, 0.44, 0.4)[k // 9]
        middle = np.array([reach * x * SIZE[0] / focal, reach * y * SIZE[1] / focal, 1.0])
        width, height = TARGET.size
        yield np.concatenate([turn, far * middle - rotation @ [width / 2, height / 2, 0.0]])


@pytest.fixture(scope="module")
def frames() -> dict[str, list[np.ndarray]]:
    """What a webcam and a fisheye see of the printed target."""
    picture, target_from_bitmap = bitmap(read_page(target_pdf(TARGET, "a4")), per_mm=5.0)
    rng = np.random.default_rng(8)
    return {
        name: [
            drawn_view(picture, target_from_bitmap, lens, pose, rng, SIZE) for pose in poses(float(lens[0]))
        ]
        for name, lens in (("pinhole", PINHOLE), ("fisheye", FISHEYE))
    }


def folder_of(images: list[np.ndarray], path: Path) -> Path:
    path.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(path / f"{k:03d}.png"), image)
    return path


@pytest.mark.parametrize(("name", "true"), first_quick([("fisheye", FISHEYE), ("pinhole", PINHOLE)], 1))
def test_images_become_settings_that_an_agent_reads(name, true, frames, capfd, tmp_path):
    robot = tmp_path / "r0.toml"
    robot.write_text(
        '# a robot\n[robot]\ndriver = "koala"\n\n[robot.camera]\nsource = "2"  # front\n\n[agent]\n'
    )
    images = folder_of(frames[name], tmp_path / "views")
    words = ["--settings", str(robot), "--height", "0.25", "--json", *OPTIONS]
    assert main(["calibrate", "camera", str(images), *words]) == 0
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert report["written"] and report["uncertainty_px"] < 0.7
    assert min(report["held_out_px"].values()) < 0.3
    text = robot.read_text()
    assert text.startswith("# a robot\n[robot]\n") and 'source = "2"  # front' in text and "[agent]" in text
    settings = load_settings(robot).robot
    description = settings.describe(Geometry(radius=0.2, axle=0.25, max_forward=0.3, max_turn=0.8))
    assert description.camera.mount_height == 0.25
    # Over the part of the image that the agent sees: where OpenCV sees rays with the true numbers.
    lens = Lens(description.camera, description.distortion)
    ideal = np.stack(np.meshgrid(np.linspace(0, 319, 9), np.linspace(0, 239, 7)), -1).reshape(-1, 2)
    c = description.camera
    rays = np.column_stack([(ideal - [c.cx, c.cy]) / [c.fx, c.fy], np.ones(len(ideal))])
    off = lens.distort(ideal) - pixels_of(true, np.zeros(6), rays)
    seen = ((lens.distort(ideal) > 0) & (lens.distort(ideal) < np.array(SIZE) - 1)).all(axis=1)
    # The camera's direction is not what a calibration tells: a common shift is left out.
    assert np.abs(off[seen] - np.median(off[seen], axis=0)).max() < 5.0 * report["uncertainty_px"]
    assert np.linalg.norm(off[seen] - np.median(off[seen], axis=0), axis=1).mean() < 0.4


def test_of_three_images_the_report_is_json_and_says_what_is_missing(frames, capfd, tmp_path):
    """No part of so few can be held out: that error was Infinity, which no other program reads."""
    images = folder_of(frames["pinhole"][::12][:3], tmp_path / "views")
    assert main(["calibrate", "camera", str(images), "--height", "0.25", "--json", *OPTIONS]) == NO
    output = capfd.readouterr()
    report = json.loads(output.out.splitlines()[-1], parse_constant=pytest.fail)
    assert set(report["held_out_px"].values()) == {None}
    assert "px off" not in output.err and "show the board at least 4 times" in output.err


class EmulatedCamera:
    """Gives the frames one by one, each twice, as a person holds the board still."""

    def __init__(self, frames: list[np.ndarray], interrupted: bool = False) -> None:
        self._interrupted = interrupted
        self._frames, self.given, self.closed = [frame for frame in frames for _ in range(2)], 0, False

    def newer(self, stamp_ns: int, patience: float) -> StampedImage | None:
        if self.given == len(self._frames):
            if self._interrupted:
                raise KeyboardInterrupt
            return None
        self.given += 1
        return StampedImage(self.given, self._frames[self.given - 1])

    def close(self) -> None:
        self.closed = True


@pytest.mark.slow
def test_a_person_is_guided_live_until_the_views_suffice(frames, monkeypatch, capfd, tmp_path):
    camera = EmulatedCamera(frames["fisheye"] * 2)
    opened: list[str] = []
    monkeypatch.setattr(
        mapweave.agent.drivers.camera, "Capture", lambda settings: opened.append(settings.source) or camera
    )
    robot = tmp_path / "r1.toml"
    arguments = ["--settings", str(robot), "--source", "rtsp://camera/1", "--height", "0.3", "--http", "0"]
    assert main(["calibrate", "camera", *arguments, *OPTIONS]) == 0
    assert camera.closed and opened == ["rtsp://camera/1"]
    assert camera.given < len(frames["fisheye"]) * 4, "it ends by itself"
    output = capfd.readouterr().out
    assert "guidance on http://127.0.0.1:" in output
    table = camera_table(robot)
    assert (table["source"], table["lens"], table["width"]) == ("rtsp://camera/1", "equidistant", 320)


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_stream_that_ends_early_is_refused_with_what_is_missing(
    interrupted, frames, monkeypatch, capfd, tmp_path
):
    camera = EmulatedCamera(frames["pinhole"][:5], interrupted)
    monkeypatch.setattr(mapweave.agent.drivers.camera, "Capture", lambda settings: camera)
    robot = tmp_path / "r1.toml"
    assert main(["calibrate", "camera", "--settings", str(robot), "--height", "0.3", *OPTIONS]) == NO
    errors = capfd.readouterr().err.splitlines()
    assert errors[0] == "mapweave: calibration refused: hold the board nearer to the upper edge"
    assert any("show the board in the lower left corner of the image" in line for line in errors)
    assert not robot.exists()


def test_the_page_shows_the_camera_and_the_guidance(frames):
    from mapweave.drawing.guidance_picture import guidance_picture
    from mapweave.scenarios.live import LiveFilm
    from mapweave.vision.calibration.collection import ViewCollection
    from mapweave.vision.calibration.views import BoardDetector

    collection = ViewCollection(BoardDetector(TARGET))
    for image in frames["pinhole"][:3]:
        for _ in range(2):
            guidance = collection.see(image)
    assert collection.views and guidance.hint
    picture = guidance_picture(image, guidance, collection.views)
    assert picture.shape == (710, 800, 3)
    with LiveFilm(0, "Camera calibration") as page:
        page.show(picture)
        with urllib.request.urlopen(page.url) as answer:
            assert answer.status == 200
        assert page.latest()[0] == 1


def test_a_video_is_read_where_the_board_is_still(frames, capfd, tmp_path):
    twice = [image for image in frames["pinhole"][:12] for _ in range(2)]
    path = write_video(tmp_path / "board.avi", twice, 10.0, "FFV1")
    assert main(["calibrate", "camera", str(path), "--lens", "radial-tangential", "--json", *OPTIONS]) in (
        0,
        NO,
    )
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert 8 <= report["views"] <= 12, "a view of each place: the frame after the board has stopped"
    assert report["fx"] == pytest.approx(280.0, rel=0.05)


def test_the_target_is_written(capfd, tmp_path):
    out = tmp_path / "board.pdf"
    assert main(["calibrate", "target", "--paper", "letter", "--out", str(out)]) == 0
    assert out.read_bytes() == target_pdf(CalibrationTarget(), "letter")
    assert "Print it at 100 %" in capfd.readouterr().out
    arguments = ["--pattern", "chessboard", "--squares", "9x6", "--square-mm", "20", "--out", str(out)]
    assert main(["calibrate", "target", *arguments]) == 0
    assert read_page(out.read_bytes()).rectangles[0, 2] == pytest.approx(20.0)


def test_the_result_is_shown_where_it_is_not_written(frames, capfd, tmp_path):
    """A person has shown the target for ten minutes: what was measured is not lost."""
    images = folder_of(frames["pinhole"], tmp_path / "views")
    assert main(["calibrate", "camera", str(images), *OPTIONS]) == 0
    *_, why, width, height, fx, _, _, _, lens, distortion = capfd.readouterr().out.splitlines()
    assert why == "no --settings FILE: nothing is written. For [robot.camera], or a recording's camera.toml:"
    assert (width, height, fx[:8], lens) == (
        "width = 320", "height = 240", "fx = 279", 'lens = "radial-tangential"',
    )  # fmt: skip
    robot = tmp_path / "r0.toml"
    robot.write_text("robot = { camera = { height_m = 0.3 } }\n")
    again = ["--lens", "radial-tangential", "--settings", str(robot)]
    assert main(["calibrate", "camera", str(images), *again, *OPTIONS]) == 1
    output = capfd.readouterr()
    assert output.out.splitlines()[-1] == distortion and f"{robot} cannot be written. For" in output.out
    (line,) = output.err.splitlines()
    assert "nothing is changed" in line


def test_images_that_do_not_suffice_or_fit_are_named(frames, capfd, tmp_path):
    one = folder_of(frames["pinhole"][:1], tmp_path / "one")
    assert "1 view of the target; three are" in complaint(
        capfd, "calibrate", "camera", one, *OPTIONS, status=NO
    )
    images = [*frames["pinhole"][:3], cv2.resize(frames["pinhole"][3], (640, 480))]
    mixed = folder_of(images, tmp_path / "mixed")
    said = complaint(capfd, "calibrate", "camera", mixed, *OPTIONS)
    assert "different sizes: 320x240, 640x480; 003.png is 640x480" in said


def test_mistakes_are_one_line(frames, capfd, tmp_path):
    blank = folder_of([np.full((240, 320), 99, np.uint8)] * 2, tmp_path / "blank")
    robot = tmp_path / "r0.toml"
    assert "no view shows the target (charuco 7x10" in complaint(
        capfd, "calibrate", "camera", blank, status=NO
    )
    assert "give --height" in complaint(
        capfd, "calibrate", "camera", blank, "--settings", robot, status=USAGE
    )
    assert "no such folder or video" in complaint(capfd, "calibrate", "camera", tmp_path / "none")
    assert "give two numbers" in complaint(capfd, "calibrate", "target", "--squares", "7", status=USAGE)
    assert "do not fit on a4" in complaint(capfd, "calibrate", "target", "--square-mm", "60", status=USAGE)
    robot.write_text("robot = { camera = { height_m = 0.3 } }\n")
    with pytest.raises(SettingsError, match=r"no table \[robot.camera\]"):
        write_camera(robot, {"fx": 1.5})
    assert robot.read_text() == "robot = { camera = { height_m = 0.3 } }\n"
    robot.write_text("[robot\n")
    assert "r0.toml" in complaint(capfd, "calibrate", "camera", blank, "--settings", robot)
