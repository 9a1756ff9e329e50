"""`mapweave calibrate drive` on rendered drives; `replay` takes what it has written."""

import io
import json
import re
import shutil
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from mapweave.agent.calibration import recorded_drive
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.recordings.geometry_file import read_geometry
from mapweave.cli import main
from mapweave.exit_status import INTERRUPTED, NO, USAGE
from tests.agent.calibration.room_drive import CAMERA, drive, write
from tests.mapweave.command_line import complaint

SMALL = replace(CAMERA, width=160, height=120, fx=138.5, fy=138.5, cx=79.5, cy=59.5)
TRUE = DriveGeometry(forward=0.3, heading=0.04, height=0.25)
DECLARED = {"forward_m = 0.3": "forward_m = 0.08"}
OWN_ROBOT = """\
from pathlib import Path
from mapweave.agent.drivers.replay import Replay

class Recorded(Replay):
    def __init__(self, settings):
        super().__init__(Path({folder!r}))
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """14 s in small images; the camera is 22 cm further ahead than declared, and looks 2.3 degrees aside."""
    folder = tmp_path_factory.mktemp("recordings") / "Room-1"
    write(drive(np.random.default_rng(0), TRUE, 14.0, camera=SMALL), folder)
    text = (folder / "camera.toml").read_text()
    for true, declared in DECLARED.items():
        assert true in text
        text = text.replace(true, declared)
    (folder / "camera.toml").write_text(text)
    return folder


@pytest.fixture
def folder(recording: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(recording, tmp_path / "Room-1"))


def calibrated(capfd: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Figures of a calibration that succeeds."""
    assert main(["calibrate", "drive", *map(str, arguments), "--json"]) == 0
    figures: dict[str, Any] = json.loads(capfd.readouterr().out.splitlines()[-1])
    return figures


@pytest.mark.slow
def test_a_narrow_terminal_cuts_no_number(recording: Path, tmp_path, monkeypatch):
    """On 40 columns a delay of -0.018 s was `-0.0…`."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=40, color_system=None)
    monkeypatch.setattr("mapweave.terminal.plain_or_terminal", lambda **_: console)
    assert main(["calibrate", "drive", str(recording), "--calibration", str(tmp_path)]) == 0
    rows = [line for line in file.getvalue().splitlines() if line.startswith("│") and "." in line]
    assert max(map(len, rows)) <= 40
    numbers = [re.findall(r"-?\d+\.\d{3}(?= *│)", row) for row in rows]
    assert len(numbers) == len(Parameter) and all(len(row) == 3 for row in numbers)


@pytest.mark.slow
def test_a_drive_is_calibrated_under_the_robots_name(recording: Path, tmp_path, capfd):
    figures = calibrated(capfd, recording, "--calibration", tmp_path)
    parameters = figures["parameters"]
    assert set(parameters) == {p.name.lower() for p in Parameter}
    truth = {"forward": TRUE.forward, "heading": np.degrees(TRUE.heading), "pitch": 0.0, "delay": 0.0}
    for name, true in truth.items():
        found = parameters[name]
        assert found["shown"], name
        assert abs(found["estimated"] - true) < 3.0 * found["sigma"], name
    assert parameters["forward"]["declared"] == pytest.approx(0.08)
    assert figures["written"]
    assert figures["estimated_px"] < figures["declared_px"]
    written = read_geometry(tmp_path / "room-1.toml")
    assert written["forward"] == pytest.approx(parameters["forward"]["estimated"], rel=1e-4)
    # What replay is given by that name it must read.
    (tmp_path / "room-1.toml").write_text("pitch_deg = 80")
    line = complaint(
        capfd, "replay", recording, "--offline", "--data", tmp_path / "maps", "--calibration", tmp_path
    )
    assert "pitch_deg is 80" in line


@pytest.mark.slow
def test_a_robot_is_watched_while_it_is_driven(recording: Path, tmp_path, capfd):
    driver = tmp_path / "own.py"
    driver.write_text(OWN_ROBOT.format(folder=str(recording)))
    robot = f"{driver}:Recorded"
    # A later calibration begins with what an earlier one has found.
    (tmp_path / "r7.toml").write_text("forward_m = 0.2\nheading_deg = 2.0\n")
    given = ["--robot", robot, "--name", "r7", "--calibration", tmp_path, "--seconds", 13]
    forward = calibrated(capfd, *given)["parameters"]["forward"]
    assert forward["declared"] == pytest.approx(0.2)
    assert forward["estimated"] == pytest.approx(TRUE.forward, abs=0.06)
    assert read_geometry(tmp_path / "r7.toml")["forward"] == pytest.approx(forward["estimated"], rel=1e-4)
    assert "too short" in complaint(capfd, "calibrate", "drive", *given[:-1], 3, status=NO)


@pytest.mark.slow
def test_an_estimate_that_predicts_worse_is_not_written_and_the_exit_status_says_so(
    recording: Path, tmp_path, capfd, monkeypatch
):
    def worse(*arguments: Any) -> recorded_drive.DriveCalibration:
        found = calibrate(*arguments)
        return replace(found, estimated_px=found.declared_px + 1.0)

    calibrate = recorded_drive.calibrate
    monkeypatch.setattr(recorded_drive, "calibrate", worse)
    command = ["calibrate", "drive", str(recording), "--calibration", str(tmp_path), "--json"]
    assert main(command) == NO
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["written"] is False
    assert not list(tmp_path.glob("*.toml"))


@pytest.mark.slow
def test_bad_input_is_one_line(folder: Path, tmp_path, capfd):
    command = ["calibrate", "drive", folder, "--calibration", tmp_path]
    assert "--robot DRIVER" in complaint(capfd, "calibrate", "drive", status=USAGE)
    assert "--name" in complaint(capfd, "calibrate", "drive", "--robot", "koala", status=USAGE)
    assert "nowhere" in complaint(capfd, "calibrate", "drive", tmp_path / "nowhere")
    odometry = (folder / "odometry.csv").read_text()
    lines = [line.split(",") for line in odometry.splitlines()]
    straight = [",".join([*line[:-1], "0" if k else line[-1]]) for k, line in enumerate(lines)]
    (folder / "odometry.csv").write_text("\n".join(straight) + "\n")
    assert "turns by 0 degrees" in complaint(capfd, *command, status=NO)
    (folder / "odometry.csv").write_text(odometry)
    (folder / "splits.toml").write_text('[[robot]]\nname = "a"\nfirst = 0\nlast = 40\n')
    assert "too short" in complaint(capfd, *command, "--robot", "a", status=NO)
    assert not list(tmp_path.glob("*.toml"))


@pytest.mark.slow
def test_turns_of_the_other_sign_are_named_and_nothing_is_written(folder: Path, tmp_path, capfd):
    """A pitch of 180 degrees was written with status 0, with which no agent starts."""
    header, *lines = (folder / "odometry.csv").read_text().splitlines()
    rows = [list(map(float, line.split(","))) for line in lines]
    spoilt = [f"{stamp},{forward},{-turned}" for stamp, forward, turned in rows]
    (folder / "odometry.csv").write_text("\n".join([header, *spoilt, ""]))
    assert main(["calibrate", "drive", str(folder), "--calibration", str(tmp_path)]) == NO
    said = " ".join(capfd.readouterr().out.split())
    assert "turns the other way than the odometry" in said and "nothing is written" in said
    assert "Written to" not in said
    assert not list(tmp_path.glob("*.toml"))


def test_a_geometry_that_cannot_be_read_again_is_not_written(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    live = LIVE.replace('Path("closed")', f"Path({str(tmp_path / 'closed')!r})")
    Path("live.py").write_text(f"SILENT = False\n{live}")
    zero = np.zeros(len(Parameter))
    estimate = SimpleNamespace(
        declared=zero, vector=zero, covariance=np.eye(len(zero)), shown=zero > 0.0, pairs=0, floor_tracks=0,
        usable=DriveGeometry(pitch=3.1),
    )  # fmt: skip
    found = recorded_drive.DriveCalibration(estimate, 2.0, 1.0)  # type: ignore[arg-type]
    monkeypatch.setattr(recorded_drive, "calibrate", lambda *_: found)
    monkeypatch.setattr("mapweave.commands.calibrate_drive._print", lambda *_: {})
    assert main(["calibrate", "drive", "--robot", "live.py:Live", "--name", "r0"]) == NO
    assert "pitch_deg is 177.6" in capfd.readouterr().out
    assert not Path("out").exists()


LIVE = """
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError

class Live:
    def __init__(self, settings):
        self.ticks = 0

    def describe(self):
        if SILENT:
            raise DeviceError("no answer")
        return RobotDescription(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3))

    def sense(self):
        self.ticks += 1
        image = np.full((48, 64), self.ticks, np.uint8) if self.ticks < 5 else None
        return Observation(self.ticks * 100_000_000, Odometry(0.01, 0.0), image)

    def act(self, command):
        return command

    def close(self):
        Path("closed").touch()
"""


@pytest.mark.parametrize("silent", [True, False])
def test_a_robot_that_fails_while_it_is_calibrated_is_closed_and_named(
    silent: bool, tmp_path, monkeypatch, capfd
):
    """A camera left open ended the process with a signal; a silent base counted as one that stands."""
    monkeypatch.chdir(tmp_path)
    Path("live.py").write_text(f"SILENT = {silent}\n{LIVE}")
    said = complaint(capfd, "calibrate", "drive", "--robot", "live.py:Live", "--name", "r0")
    assert ("no answer" if silent else "the camera gives no image") in said
    # As the guide has it, with the driver of the settings.
    Path("r0.toml").write_text('[robot]\ndriver = "live.py:Live"\n')
    assert complaint(capfd, "calibrate", "drive", "--settings", "r0.toml", "--name", "r0") == said
    assert Path("closed").exists()
    assert not Path("out").exists()


@pytest.mark.parametrize("silent", [True, False])
def test_ctrl_c_before_the_drive_suffices_is_an_interruption_and_no_answer(
    silent: bool, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    # It is closed by a thread, which may be later than this test.
    live = LIVE.replace('Path("closed")', f"Path({str(tmp_path / 'closed')!r})")
    Path("live.py").write_text(f"SILENT = {silent}\n{live}")
    pressed = threading.Event()
    pressed.set()
    monkeypatch.setattr("mapweave.commands.calibrate_drive.stop_on_signals", lambda: pressed)
    command = ["calibrate", "drive", "--robot", "live.py:Live", "--name", "r0"]
    said = complaint(capfd, *command, status=INTERRUPTED)
    assert ("no answer" if silent else "too short") in said
    assert Path("closed").exists()
    assert not Path("out").exists()
