"""`mapweave doctor`: each thing that can be wrong is found, and named before what follows from it."""

import io
import json
import shlex
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from mapweave.agent.drivers import camera as driver_camera
from mapweave.agent.drivers import wheeled
from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.cli import main
from mapweave.commands import doctor as doctor_command
from mapweave.doctor import camera, camera_model, driver, libraries, machine
from mapweave.doctor.finding import Finding, FindingLevel
from mapweave.doctor.motion import MotionComparison
from mapweave.exit_status import NO
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.children import free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, encode_record
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.agent.drivers.emulators import ArduinoSketch
from tests.mapweave.expired_key import EXPIRED, expired_key
from tests.programs import python
from tests.recordings import write_video
from tests.rtsp_stream import RtspStream
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 320, 240


def doctor(capfd: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, Finding], str]:
    """Exit status, findings by their subjects, and the subject of the first that is wrong."""
    status = main(["doctor", "--json", *map(str, words)])
    answer = json.loads(capfd.readouterr().out)
    found = [Finding(**{**one, "verdict": FindingLevel(one["verdict"])}) for one in answer["findings"]]
    findings = {one.subject: one for one in found}
    return status, findings, (answer["first_wrong"] or {"subject": ""})["subject"]


# Libraries


@pytest.mark.parametrize("missing", [
    ["cv2"], ["cv2", "msgpack", "msgspec", "networkx", "numpy", "rich", "rosbags", "serial", "zenoh"],
])  # fmt: skip
def test_it_runs_without_libraries_and_names_them(missing: list[str], tmp_path):
    commands = [
        ["doctor", "--json", "--data", str(tmp_path), "--offline"],
        ["doctor", "--data", str(tmp_path), "--offline"],
    ]
    program = "tests.mapweave.without_libraries"
    ran = python("-m", program, *missing, input=json.dumps(commands), check=True, cwd=ROOT)
    (status, out, err), (plain_status, plain, plain_err) = json.loads(ran.stdout)
    assert status == plain_status == NO and not err and not plain_err
    wrong = [one for one in json.loads(out)["findings"] if one["verdict"] == "wrong"]
    assert len(wrong) == len(missing)
    assert all("is not installed" in one["detail"] and "pip install" in one["advice"] for one in wrong)
    assert json.loads(out)["first_wrong"] == wrong[0]
    assert all(one["subject"].removeprefix("library ") in plain for one in wrong)
    assert "first: library" in plain


def test_an_extra_that_is_not_installed_comes_with_the_pip_of_this_environment(monkeypatch):
    """Where the environment is not activated a bare `pip` is another one, or none."""
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(libraries, "find_spec", lambda module: None)
    advice = {one.subject: one.advice for one in libraries.examine()}
    assert advice["extra eval"] == f"{shlex.quote(sys.executable)} -m pip install 'mapweave[eval]'"


# The computer


def test_a_clock_before_the_installation_and_a_place_that_is_no_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 3600.0)
    (finding,) = machine.clock()
    assert finding.verdict is FindingLevel.WRONG and "1970" in finding.detail
    (tmp_path / "file").write_text("")
    *_, finding = machine.disk(tmp_path / "file")
    assert finding.verdict is FindingLevel.WRONG and "--data" in finding.advice


def test_a_full_or_slow_disk(tmp_path, monkeypatch):
    usage = machine.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda path: usage._replace(free=5_000_000))
    (finding,) = machine.disk(tmp_path)
    assert finding.verdict is FindingLevel.WRONG and "free" in finding.advice
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda path: usage._replace(free=10**10))
    assert next(machine.disk(tmp_path)).verdict is FindingLevel.GOOD
    monkeypatch.setattr(machine, "SLOW_SYNC", 0.0)
    assert next(machine.disk(tmp_path)).verdict is FindingLevel.WARNING


# Calibration

CAMERA = Camera(640, 480, 610.0, 612.0, 322.0, 238.0, 0.25, 0.1)


@pytest.mark.parametrize(("declared", "distortion", "words"), [
    (replace(CAMERA, fx=61.0), (0.0,) * 5, "field of view 158 degrees"),
    (replace(CAMERA, fy=480.0), (0.0,) * 5, "not the same"),
    (replace(CAMERA, cx=610.0), (0.0,) * 5, "cx = 610"),
    (replace(CAMERA, mount_height=25.0), (0.0,) * 5, "height_m = 25"),
    (replace(CAMERA, mount_forward=10.0), (0.0,) * 5, "forward_m = 10"),
    (CAMERA, (-1.2, 0.0, 0.0, 0.0, 0.0), "folds the image back"),
])  # fmt: skip
def test_a_calibration_that_cannot_be_right(declared, distortion, words):
    (finding,) = camera_model.examine(RobotDescription(declared, distortion))
    assert finding.verdict is FindingLevel.WRONG and words in finding.detail
    assert "mapweave calibrate" in finding.advice


def test_distortion_folds_where_opencv_brings_two_points_to_one():
    description = RobotDescription(CAMERA, (-1.2, 0.1, 0.0, 0.0, 0.0))
    radius = camera_model.folding_radius(description)
    rays = np.zeros((2000, 3))
    rays[:, 0], rays[:, 2] = np.linspace(0.0, 1.0, 2000), 1.0
    matrix = np.array([[610.0, 0, 0], [0, 610.0, 0], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(description.distortion))
    assert radius == pytest.approx(610.0 * rays[int(pixels[:, 0, 0].argmax()), 0], rel=0.03)
    assert camera_model.folding_radius(RobotDescription(CAMERA, (-0.28, 0.07, 0.0, 0.0, 0.0))) is None
    good = list(camera_model.examine(RobotDescription(CAMERA, (-0.28, 0.07, 0.0, 0.0, 0.0))))
    assert [one.verdict for one in good] == [FindingLevel.GOOD]


# Camera and driver: a video file for the one, a pseudo-terminal for the other


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a second of images and of observations is enough here."""
    monkeypatch.setattr(camera, "SECONDS", 0.5)
    monkeypatch.setattr(driver, "SECONDS", 0.5)
    monkeypatch.setattr(driver, "DRIVE_SECONDS", 1.0)
    monkeypatch.setattr(driver, "TURN_SECONDS", 1.0)
    monkeypatch.setattr(wheeled, "PATIENCE", 0.5)


@pytest.fixture(scope="module")
def walls() -> PhotoWalls:
    return PhotoWalls()


def film(path: Path, walls: PhotoWalls, spoil=lambda image: image, moves: bool = True) -> Path:
    """A camera that moves a little, or repeats one image."""
    images = [spoil(walls.render(Pose2(0.01 * k if moves else 0.0))) for k in range(8)]
    return write_video(path, [image for image in images for _ in range(10)], 20.0)


def robot_toml(folder: Path, video: Path | str, port: object, width: int = WIDTH) -> Path:
    path = folder / "robot.toml"
    path.write_text(f"""
[robot]
driver = "arduino"
[robot.options]
port = "{port}"
wheel_radius = 0.033
counts_per_turn = 1440
[robot.geometry]
radius = 0.12
axle = 0.15
ranger_bearings_deg = [45, 0, -45]
ranger_reach = 1.5
[robot.camera]
source = "{video}"
width = {width}
height = {HEIGHT}
fx = 277
fy = 277
cx = {width / 2}
cy = 120
height_m = 0.3
""")
    return path


@pytest.fixture
def sketch(tmp_path: Path, opened) -> ArduinoSketch:
    return opened(ArduinoSketch(tmp_path))


@pytest.mark.slow
def test_a_robot_whose_camera_is_another_one(walls, sketch, tmp_path, capfd):
    """All is well but that the camera does not see the drive; without --drive nothing moves."""
    sketch.distances = [200, 200, 200]
    still = film(tmp_path / "still.avi", walls, moves=False)
    settings = robot_toml(tmp_path, still, sketch.path)
    status, findings, first = doctor(
        capfd, "--settings", settings, "--drive", "--offline", "--data", tmp_path
    )
    assert findings["camera"].verdict is FindingLevel.GOOD and "320x240 px" in findings["camera"].detail
    assert findings["driver"].verdict is FindingLevel.GOOD
    assert "3 proximity sensors" in findings["driver"].detail
    assert findings["encoders"].verdict is FindingLevel.WRONG
    assert "the encoders count and the image stands still" in findings["encoders"].detail
    eventually(lambda: sketch.wheels.speeds == (0.0, 0.0))
    assert 0.08 < sketch.wheels.way()[1] < 0.2
    assert status == NO and first in ("image", "encoders")


def test_a_robot_that_is_not_pushed_and_a_wrong_size(walls, sketch, tmp_path, capfd):
    settings = robot_toml(tmp_path, film(tmp_path / "film.avi", walls), sketch.path, width=640)
    status, findings, first = doctor(capfd, "--settings", settings, "--offline", "--data", tmp_path)
    assert status == NO and first == "camera" and "320x240" in findings["camera"].detail
    assert "declared as 640x240" in findings["camera"].detail
    assert sketch.wheels.way() == (0.0, 0.0)


def test_a_dark_camera_and_a_port_that_is_not_there(walls, tmp_path, capfd):
    dark = film(tmp_path / "dark.avi", walls, lambda image: (image * 0.02).astype(np.uint8))
    settings = robot_toml(tmp_path, dark, tmp_path / "ttyUSB7")
    status, findings, first = doctor(capfd, "--settings", settings, "--offline", "--data", tmp_path)
    assert (status, first) == (NO, "image") and "dark" in findings["image"].detail
    assert findings["driver"].verdict is FindingLevel.WRONG and "no such port" in findings["driver"].detail
    assert "mapweave find-port" in findings["driver"].advice


def test_a_port_that_another_program_uses(walls, sketch, tmp_path, capfd):
    settings = robot_toml(tmp_path, film(tmp_path / "film.avi", walls), sketch.path)
    port = SerialPort(str(sketch.path), 115200)
    _, findings, first = doctor(capfd, "--settings", settings, "--offline", "--data", tmp_path)
    port.close()
    assert first == "driver" and "in use by another process" in findings["driver"].detail
    assert "a running agent" in findings["driver"].advice


def test_a_driver_with_few_images(walls):
    image = walls.render(Pose2())
    seen = [
        Observation(k * 10**8, Odometry(0.0, 0.0), image if k % 4 == 0 else None, np.full(3, 1.0))
        for k in range(20)
    ]
    description = replace(DESCRIPTION, ranger_bearings=(0.5, 0.0, -0.5), ranger_reach=1.5)
    (finding,) = driver._judge(description, seen)
    assert finding.verdict is FindingLevel.WARNING and "5 with an image" in finding.detail


def test_the_end_of_the_terminal_is_no_person(monkeypatch):
    def end(words: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", end)
    assert not doctor_command._ask("Push the robot")


def test_no_camera_and_wrong_settings(tmp_path, capfd):
    settings = robot_toml(tmp_path, tmp_path / "none.avi", tmp_path / "none")
    _, findings, first = doctor(capfd, "--settings", settings, "--offline", "--data", tmp_path)
    assert first == "camera" and "find-cameras" in findings["camera"].advice
    settings.write_text("[robot]\ndrivre = 1\n")
    _, findings, first = doctor(capfd, "--settings", settings, "--offline", "--data", tmp_path)
    assert first == "settings" and "did you mean 'driver'" in findings["settings"].detail
    _, findings, _ = doctor(capfd, "--robot", "koala", "--offline", "--data", tmp_path)
    assert "driver koala" in findings["settings"].detail


def test_an_option_that_is_missing_is_asked_for_in_the_file_of_the_robot(tmp_path, capfd):
    """It was "give that with --settings FILE" where --robot FILE had been given."""
    settings = tmp_path / "robot.toml"
    settings.write_text('[robot]\ndriver = "arduino"\n')
    _, findings, first = doctor(capfd, "--robot", settings, "--offline", "--data", tmp_path)
    assert first == "driver"
    assert "write it in the robot's settings file, and give that with --robot FILE.toml" in (
        findings["driver"].detail
    )


def test_what_a_stream_lacks_is_said_without_its_password(tmp_path, capfd, opened, monkeypatch):
    monkeypatch.setattr(driver_camera, "STREAM_PATIENCE", 0.0)
    place = opened(RtspStream(lambda: b"", "bob:secret")).place
    settings = robot_toml(tmp_path, f"rtsp://bob:secret@{place}/none", tmp_path / "ttyUSB7")
    _, findings, first = doctor(capfd, "--robot", settings, "--offline", "--data", tmp_path)
    assert first == "camera"
    assert findings["camera"].detail.endswith(f"{place} has nothing at /none: mend the path")
    assert "[robot.camera] source" in findings["camera"].advice
    assert not any("secret" in one.detail for one in findings.values())


# Encoders against the image


@pytest.fixture(scope="module")
def push(walls: PhotoWalls) -> list:
    """0.3 m forward and 20 degrees to the left, then the same back."""
    poses = [Pose2(0.02 * k, 0.0, 0.0) for k in range(16)] + [Pose2(0.3, 0.0, 0.035 * k) for k in range(11)]
    poses += poses[::-1]
    return [walls.observe(before, now, k) for k, (before, now) in enumerate(pairwise(poses))]


@pytest.mark.parametrize(("spoil", "verdict", "words"), [
    (lambda one, first: one, FindingLevel.GOOD, "agree with the image"),
    (lambda one, first: replace(one, odometry=Odometry(0.0, 0.0)), FindingLevel.WRONG,
     "encoders do not count"),
    (lambda one, first: replace(one, image=first.image), FindingLevel.WRONG, "the image stands still"),
    (lambda one, first: replace(one, odometry=Odometry(one.odometry.forward, -one.odometry.turn)),
     FindingLevel.WRONG, "the image turns the other way"),
    (lambda one, first: replace(one, odometry=Odometry(-one.odometry.forward, one.odometry.turn)),
     FindingLevel.WRONG, "forward by the encoders is backward by the image"),
    (lambda one, first: replace(one, odometry=Odometry(one.odometry.forward, one.odometry.turn / 2)),
     FindingLevel.WRONG, "turns 2.0"),
    (lambda one, first: replace(one, image=first.image, odometry=Odometry(0.0, 0.0)), FindingLevel.SKIPPED,
     "nothing has moved"),
    (lambda one, first: replace(one, image=np.full_like(one.image, 90)), FindingLevel.SKIPPED,
     "too little to follow"),
])  # fmt: skip
def test_encoders_are_compared_with_the_image(push, spoil, verdict, words):
    comparison = MotionComparison(DESCRIPTION)
    for one in push:
        comparison.see(spoil(one, push[0]))
    (finding,) = comparison.judge()
    assert finding.verdict is verdict and words in finding.detail, finding


class Cornered:
    """It can turn on the spot, and something is ahead of it wherever it looks."""

    def __init__(self, walls: PhotoWalls) -> None:
        self._walls, self._number, self._turn, self._pose = walls, 0, 0.0, Pose2()

    def describe(self) -> RobotDescription:
        return replace(DESCRIPTION, ranger_bearings=(0.0,), ranger_reach=1.5)

    def sense(self) -> Observation:
        before, self._pose = self._pose, self._pose @ Pose2(0.0, 0.0, 0.1 * self._turn)
        self._number += 1
        return replace(self._walls.observe(before, self._pose, self._number), proximity=np.array([0.02]))

    def act(self, command: Command) -> Command:
        self._turn = command.turn
        return Command(0.0, command.turn)

    def close(self) -> None:
        pass


def test_a_robot_that_was_stopped_before_an_obstacle_needs_free_floor(walls):
    """It drove by itself, and the advice was to drive a little more."""
    robot = Cornered(walls)
    (finding,) = driver._motion(robot, robot.describe(), True, lambda words: False)
    assert finding.verdict is FindingLevel.WARNING and "too little motion" in finding.detail
    assert finding.advice.startswith("stopped: an obstacle is ahead: put the robot where")


# The server


@pytest.fixture
def router() -> Iterator[tuple[ZenohBus, str]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
    yield bus, endpoint
    bus.close()


def test_servers(router: tuple[ZenohBus, str], tmp_path, capfd):
    bus, endpoint = router
    asked = ("--connect", endpoint, "--fleet", "ours", "--data", tmp_path)
    status, findings, first = doctor(capfd, *asked)
    assert (status, first) == (NO, "server") and "no map server of fleet ours" in findings["server"].detail
    theirs, ours = Keys("theirs"), Keys("ours")
    other = bus.announce(theirs.server_alive("s7"))
    assert "s7 of fleet theirs" in doctor(capfd, *asked)[1]["server"].detail
    other.close()
    record: dict[str, Scalar] = {"version": "0.0.1", "summary": "3 maps"}
    serving = bus.serve(ours.server_status("s0"), lambda request: request.reply(encode_record(record)))
    status, findings, _ = doctor(capfd, *asked)
    assert status == 0 and findings["server"].verdict is FindingLevel.WARNING
    assert "0.0.1" in findings["server"].detail
    record["version"] = version("mapweave")
    assert doctor(capfd, *asked)[1]["server"].verdict is FindingLevel.GOOD
    record |= {"name": "s0", "summary": "waiting: refused", "loading": True}
    status, findings, first = doctor(capfd, *asked)
    assert (status, first) == (NO, "server")
    assert findings["server"].detail == "map server s0 is waiting: refused"
    serving.close()


def test_the_own_certificate_that_has_expired_is_named(tmp_path, capfd):
    path = expired_key(tmp_path / "keys")
    with socket.create_server(("127.0.0.1", 0)) as there:
        endpoint = f"tls/127.0.0.1:{there.getsockname()[1]}"
        words = ("--connect", endpoint, "--keys", path, "--data", tmp_path)
        status, findings, first = doctor(capfd, *words)
    assert (status, first, findings["server"].detail) == (NO, "server", EXPIRED)
    assert findings["server"].advice.startswith("`mapweave keys add r0 --role robot` at the server")


def test_nothing_listens(tmp_path, capfd):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    status, findings, first = doctor(capfd, "--connect", endpoint, "--data", tmp_path)
    assert (status, first) == (NO, "server") and "refused" in findings["server"].detail


def test_a_base_behind_the_network_has_no_serial_port(tmp_path, capfd, monkeypatch):
    """The advice was to look for its serial port."""
    monkeypatch.setattr(doctor_command, "REMOTE_PATIENCE", 0.2)
    where = ("--connect", f"tcp/127.0.0.1:{free_port()}", "--offline", "--data", tmp_path)
    _, findings, first = doctor(capfd, "--robot", "remote", "--name", "r0", *where)
    assert first == "driver" and "mapweave sim serve" in findings["driver"].detail
    assert "router" in findings["driver"].advice and "find-port" not in findings["driver"].advice


def test_a_table_names_the_first_thing_wrong(tmp_path, capfd):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{closed.getsockname()[1]}"
        assert main(["doctor", "--connect", endpoint, "--data", str(tmp_path)]) == NO
    out = capfd.readouterr().out
    assert "python" in out and f"first: server: {endpoint}" in out and "do: start `mapweave server`" in out
    assert main(["doctor", "--offline", "--data", str(tmp_path)]) == 0
    assert capfd.readouterr().out.rstrip().endswith("nothing is wrong")


def test_a_pipe_gets_a_line_for_each_check_without_padding(capfd):
    """Each line had 274 characters, most of them spaces before an empty column."""
    found = [
        Finding("encoders", FindingLevel.SKIPPED, "not compared with the image", "mapweave doctor --drive"),
        Finding("extra postgres", FindingLevel.GOOD, "installed"),
        Finding("libraries", FindingLevel.GOOD, " ".join(["eclipse-zenoh 1.10.2,"] * 20)),
    ]
    doctor_command._print(found)
    assert capfd.readouterr().out.splitlines() == [
        "skipped  encoders       not compared with the image; do: mapweave doctor --drive",
        "good     extra postgres installed",
        f"good     libraries      {found[2].detail}",
    ]


@pytest.mark.parametrize("width", [40, 60])
def test_a_narrow_terminal_cuts_no_word(width: int, monkeypatch):
    """On 40 columns the table had `observa` and `tions` on two lines, and `encode…`."""
    said = "22 observations, 10 a second, 3 proximity sensors of which one is distance-limited"
    findings = [
        Finding("encoders", FindingLevel.SKIPPED, said, "mapweave doctor --drive"),
        Finding("extra postgres", FindingLevel.WRONG, "not [installed]", "pip install mapweave[postgres]"),
    ]
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=width, color_system=None)
    monkeypatch.setattr("mapweave.terminal.plain_or_terminal", lambda stderr: console)
    doctor_command._print(findings)
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    wanted = (
        f"skipped encoders: {said} do: mapweave doctor --drive "
        "wrong extra postgres: not [installed] do: pip install mapweave[postgres]"
    )
    assert " ".join(" ".join(lines).split()) == wanted
