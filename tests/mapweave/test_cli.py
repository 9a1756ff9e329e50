"""The command line: help for everything, and one line on stderr for whatever is wrong."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.cli import main, parser
from wire.mapfile import MapFile, write_map_file

CAMERA = "width = 64\nheight = 48\nfx = 60\nfy = 60\ncx = 32\ncy = 24\nheight_m = 0.3\n"
COMMANDS = [
    "demo",
    "server",
    "sim",
    "sim run",
    "sim batch",
    "sim serve",
    "sim list",
    "agent",
    "map",
    "map show",
    "map explain",
    "map unmerge",
    "map merge",
    "map export",
    "map import",
    "replay",
    "relocalize",
    "eval",
    "eval relocalize",
]


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """Commands take signals for themselves."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def port() -> Iterator[int]:
    """A port that is taken."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield int(taken.getsockname()[1])


@pytest.fixture
def nobody() -> str:
    """An endpoint where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Three grey images without a robot that moves."""
    folder = tmp_path / "walk"
    (folder / "images").mkdir(parents=True)
    for k in range(3):
        cv2.imwrite(str(folder / "images" / f"{k}.png"), np.full((48, 64), 90, np.uint8))
    (folder / "camera.toml").write_text(CAMERA)
    (folder / "odometry.csv").write_text("forward_m,turn_rad\n" + "0,0\n" * 3)
    return folder


def complaint(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command that fails says: exactly one line."""
    assert main([str(a) for a in arguments]) == 1
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1, said
    assert said[0].startswith("mapweave: ")
    assert len(said[0]) < 400
    return said[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capfd):
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    out = capfd.readouterr().out
    assert f"usage: mapweave {command}" in out
    assert len(out.splitlines()) > 5


def test_the_list_of_commands_is_that_of_the_tests(capfd):
    (actions,) = [a for a in parser()._actions if a.dest == "==SUPPRESS==" and a.choices]
    assert set(actions.choices) == {command.split()[0] for command in COMMANDS}


@pytest.mark.parametrize(
    "arguments",
    [[], ["fly"], ["agent"], ["agent", "r0", "--driver", "legs"], ["demo", "--robots", "many"], ["map"],
     ["replay"], ["relocalize"], ["server", "--port", "1"]],
)  # fmt: skip
def test_a_wrong_use_shows_how_to_use_it(arguments, capfd):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    err = capfd.readouterr().err
    assert err.startswith("usage: mapweave")
    assert "Traceback" not in err


# Files


def test_map_files(tmp_path, capfd):
    path = tmp_path / "a.mapweave"
    assert "cannot be read" in complaint(capfd, "map", "show", path)
    assert "cannot be read" in complaint(capfd, "map", "show", tmp_path)
    path.write_bytes(b"")
    assert "is not a Mapweave map file" in complaint(capfd, "map", "show", path)
    path.write_text("{}")
    assert "is not a Mapweave map file" in complaint(capfd, "map", "show", path)
    write_map_file(path, MapFile("agent", "r0.1", ()))
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    assert "is truncated" in complaint(capfd, "map", "show", path)
    path.write_bytes(whole[:20] + b"\0" + whole[21:])
    assert "is damaged" in complaint(capfd, "map", "show", path)


def test_settings(tmp_path, capfd, recording):
    path = tmp_path / "robot.toml"
    for command in (
        ["agent", "r0"],
        ["server"],
        ["sim", "run", "office"],
        ["sim", "serve", "office"],
        ["replay", recording, "--offline"],
    ):
        assert "no such file" in complaint(capfd, *command, "--settings", path.with_name("none.toml"))
        path.write_text("[netwrok]")
        assert "did you mean 'network'?" in complaint(capfd, *command, "--settings", path)
        path.write_text("[network")
        assert "robot.toml" in complaint(capfd, *command, "--settings", path)


def test_recordings(tmp_path, capfd, recording):
    assert "no such folder" in complaint(capfd, "replay", tmp_path / "nothing")
    assert "without it there is no robot 'a'" in complaint(capfd, "replay", recording, "--robot", "a")
    (recording / "camera.toml").unlink()
    assert "camera's intrinsics" in complaint(capfd, "replay", recording)


def test_an_image_of_a_recording_that_is_broken(tmp_path, capfd, recording):
    (recording / "images" / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 50)
    arguments = ["replay", recording, "--offline", "--data", tmp_path / "data", "--epoch", 1]
    assert main([str(a) for a in arguments]) == 1
    said = capfd.readouterr().err.splitlines()
    (line,) = [line for line in said if line.startswith("mapweave: ")]
    assert "1.png: not an image that can be read" in line
    assert said[-1] == line
    assert not any("Traceback" in line for line in said)
    assert (tmp_path / "data" / "walk.mapweave").exists(), "what was mapped before is kept"


def test_places_that_cannot_be_written(tmp_path, capfd, recording, nobody):
    taken = tmp_path / "taken"
    taken.write_text("a file where a folder should be")
    assert str(taken) in complaint(capfd, "replay", recording, "--offline", "--data", taken)
    assert str(taken) in complaint(capfd, "server", "--listen", nobody, "--data", taken)
    assert str(taken) in complaint(capfd, "demo", "--out", taken)
    path = tmp_path / "a.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", one_node()))
    assert str(taken) in complaint(capfd, "map", "show", path, "--out", taken / "a.png")


def one_node():
    """A map of one place."""
    from hybridmap.camera import Camera
    from hybridmap.change import NodePut
    from hybridmap.node import Landmarks, Node, NodeId
    from hybridmap.pose import Pose2, PoseGaussian

    camera = Camera(64, 48, 60, 60, 32, 24, 0.3)
    here = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)
    return (NodePut(Node(NodeId("r0", 1, 1), 0, here, camera, Landmarks.empty())),)


# Names and numbers


@pytest.mark.parametrize("name", ["R0", "a b", "", "r0/1", "*", "ä", "x" * 33, "-x"])
def test_names_that_cannot_stand_in_a_key(name, capfd, recording, nobody, tmp_path):
    said = complaint(capfd, "agent", "--", name)
    assert "use 1 to 32 of a-z" in said
    if name:
        assert "use 1 to 32 of a-z" in complaint(capfd, "agent", "r0", "--connect", nobody, f"--fleet={name}")
        assert "use 1 to 32 of a-z" in complaint(capfd, "replay", recording, "--offline", f"--name={name}")
        data = tmp_path / "data"
        said = complaint(capfd, "server", "--listen", nobody, f"--name={name}", "--data", data)
        assert "use 1 to 32 of a-z" in said
        assert not data.exists(), "nothing is left behind"


@pytest.mark.parametrize("endpoint", ["localhost", "tcp/localhost", "http/a:1", "tcp/:1", "tcp/a b:1"])
def test_endpoints(endpoint, capfd, recording, tmp_path):
    picture = recording / "images" / "0.png"
    for command in (
        ["agent", "r0"],
        ["sim", "serve", "office"],
        ["relocalize", picture],
        ["replay", recording],
    ):
        assert "endpoint" in complaint(capfd, *command, "--connect", endpoint)
    assert "endpoint" in complaint(capfd, "server", "--listen", endpoint, "--data", tmp_path)


@pytest.mark.parametrize(
    "arguments",
    ["--robots=1", "--rooms=99", "--seed=-1"],
)
def test_demos_out_of_range(arguments, capfd, tmp_path):
    said = complaint(capfd, "demo", arguments, "--out", tmp_path)
    assert arguments.replace("=", " ") in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["office", "--seed", "-1"], "--seed -1: use 0 or more"),
        (["office", "--set", "robots=0"], "robots must be a whole number, 1 to 16"),
        (["office", "--set", "robots=17"], "robots must be a whole number, 1 to 16"),
        (["office", "--set", "world.rooms=0"], "rooms"),
        (["office", "--set", "world.kind=castle"], "no kind of world 'castle'"),
        (["office", "--set", "robots"], "write key=value"),
        (["ofice"], "no scenario 'ofice'"),
        (["nowhere.toml"], "nowhere.toml: no such file"),
    ],
)
def test_scenarios_that_cannot_be_run(arguments, words, capfd, nobody, tmp_path):
    for what in (["run", "--out", tmp_path / "out"], ["serve", "--connect", nobody]):
        assert words in complaint(capfd, "sim", what[0], *arguments, *what[1:])
    assert not (tmp_path / "out" / "agents").exists()


def test_a_batch_names_its_failures(capfd, tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(
        'robots = 1\n[world]\nkind = "arena"\n[[events]]\nat = 1.0\ndo = "wait"\n[expect]\nnodes = 77\n'
    )
    arguments = ["sim", "batch", path, "--seeds", 2, "--first", 4, "--one-process", "--out", tmp_path / "out"]
    assert main([str(a) for a in arguments]) == 2
    said = capfd.readouterr()
    assert "seed 4: nodes is" in said.err
    assert "seed 5: nodes is" in said.err
    assert main([str(a) for a in [*arguments, "--json"]]) == 2
    found = json.loads(capfd.readouterr().out.strip().splitlines()[-1])
    assert found == json.loads((tmp_path / "out" / "batch.json").read_text())
    assert "seeds" in complaint(capfd, "sim", "batch", path, "--seeds", 0)


def test_a_trial_prints_one_json_object(capfd, tmp_path):
    path = tmp_path / "one.toml"
    path.write_text(
        'robots = 1\n[world]\nkind = "arena"\n[[events]]\nat = 1.0\ndo = "wait"\n[expect]\ncollisions = 0\n'
    )
    arguments = [
        "sim",
        "run",
        str(path),
        "--one-process",
        "--out",
        str(tmp_path / "out"),
        "--json",
        "--seed",
        "9",
    ]
    assert main(arguments) == 0
    printed = json.loads(capfd.readouterr().out.strip().splitlines()[-1])
    assert (printed["passed"], printed["seed"], printed["scenario"]) == (True, 9, "one")
    assert printed["figures"]["sim_s"] == 1.0
    assert json.loads((tmp_path / "out" / "figures.json").read_text())["figures"] == printed["figures"]


def test_an_epoch_out_of_range(capfd, recording, tmp_path):
    for epoch in (-1, 2**60):
        data = tmp_path / str(epoch)
        said = complaint(capfd, "replay", recording, "--offline", "--data", data, f"--epoch={epoch}")
        assert "epoch" in said


# Network


def test_a_port_that_is_taken(capfd, port, tmp_path):
    said = complaint(capfd, "server", "--listen", f"tcp/127.0.0.1:{port}", "--data", tmp_path)
    assert f"cannot listen at tcp/127.0.0.1:{port}: the port is taken" in said


def test_a_port_for_people_that_is_taken(capfd, port, nobody, tmp_path):
    said = complaint(capfd, "server", "--listen", nobody, "--data", tmp_path / "a", "--http", port)
    assert f"cannot listen at http 127.0.0.1:{port}: the port is taken" in said
    said = complaint(capfd, "server", "--listen", nobody, "--data", tmp_path / "b", "--http", "here")
    assert "write a port, or HOST:PORT" in said
    assert not (tmp_path / "b").exists()


def test_an_address_of_another_machine(capfd, tmp_path):
    said = complaint(capfd, "server", "--listen", "tcp/192.0.2.1:7447", "--data", tmp_path)
    assert "cannot listen at tcp/192.0.2.1:7447" in said


def test_asking_where_nobody_is(capfd, recording, nobody):
    picture = recording / "images" / "0.png"
    said = complaint(capfd, "relocalize", picture, "--connect", nobody, "--timeout", "0.3")
    assert f"no router at {nobody}: start `mapweave server`" in said


def test_asking_about_an_image(capfd, recording, tmp_path, nobody):
    rest = ["--connect", nobody, "--timeout", "0.1"]
    lonely = tmp_path / "a.png"
    lonely.write_bytes((recording / "images" / "0.png").read_bytes())
    assert "give the intrinsics with --camera" in complaint(capfd, "relocalize", lonely, *rest)
    camera = ["--camera", recording / "camera.toml"]
    assert "no router" in complaint(capfd, "relocalize", lonely, *camera, *rest)
    assert "no such file" in complaint(capfd, "relocalize", lonely, "--camera", tmp_path / "b.toml", *rest)
    assert "not an image" in complaint(capfd, "relocalize", tmp_path / "b.png", *camera, *rest)
    lonely.write_text("no image")
    assert "not an image" in complaint(capfd, "relocalize", lonely, *camera, *rest)
    assert "not an image" in complaint(capfd, "relocalize", tmp_path, *camera, *rest)
    cv2.imwrite(str(lonely), np.zeros((10, 20), np.uint8))
    assert "is 20x10 px, but" in complaint(capfd, "relocalize", lonely, *camera, *rest)


def test_a_recording_without_a_server_is_mapped_all_the_same(recording, tmp_path, capfd, nobody):
    data = tmp_path / "data"
    arguments = ["replay", recording, "--data", data, "--name", "r0", "--epoch", 1, "--offline"]
    assert main([str(a) for a in arguments]) == 0
    assert "0 nodes and 0 edges" in " ".join(capfd.readouterr().err.split())
    assert main(["map", "show", str(data / "r0.mapweave"), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["nodes"] == 0


# As processes


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    """`mapweave` as a user runs it."""
    command = [sys.executable, "-m", "mapweave", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_a_process_that_fails_says_one_line_and_ends(tmp_path):
    done = run("map", "show", tmp_path / "nothing.mapweave")
    assert (done.returncode, done.stdout) == (1, "")
    assert (
        done.stderr
        == f"mapweave: {tmp_path / 'nothing.mapweave'}: cannot be read (No such file or directory)\n"
    )


def test_an_agent_that_is_interrupted_before_it_has_a_body_says_so(nobody, tmp_path):
    command = [sys.executable, "-m", "mapweave", "agent", "r0", "--connect", nobody, "--data", str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        watchdog = threading.Timer(40, process.kill)
        watchdog.start()
        eventually(lambda: (tmp_path / "r0.sqlite").exists())
        process.send_signal(signal.SIGINT)
        _, said = process.communicate()
        watchdog.cancel()
    assert "Traceback" not in said
    assert len(said.splitlines()) <= 1
    assert process.returncode in (0, 1, 130)


@pytest.fixture(autouse=True, scope="module")
def simulator() -> None:
    """PyBullet greets whoever loads it first; that is not what is tested."""
    import sim.simulation  # noqa: F401


def eventually(condition: Callable[[], object], seconds: float = 20.0) -> None:
    import time

    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.05)


def test_help_is_quick():
    """No heavy import happens before a command runs."""
    program = (
        "import sys, mapweave.cli\n"
        "mapweave.cli.parser().format_help()\n"
        "heavy = {'pybullet', 'gtsam', 'faiss', 'matplotlib', 'scipy', 'numba'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(heavy)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
