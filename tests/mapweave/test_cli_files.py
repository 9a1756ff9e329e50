"""The command line and files: one line on stderr for each error."""

import json
import os
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import Camera, MapFile, NodeId, Pose2, PoseGaussian, write_map_file
from mapweave.agent.drivers.replay import Replay
from mapweave.cli import main
from mapweave.exit_status import INTERRUPTED
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from tests.mapweave.command_line import complaint
from tests.programs import mapweave

pytestmark = pytest.mark.usefixtures("signals", "simulator")


def test_map_files(tmp_path, capfd):
    path = tmp_path / "a.mapweave"
    assert "no such file" in complaint(capfd, "map", "show", path)
    assert "is a folder" in complaint(capfd, "map", "show", tmp_path)
    path.write_bytes(b"")
    assert "is neither a map file" in complaint(capfd, "map", "show", path)
    path.write_text("{}")
    assert "is neither a map file" in complaint(capfd, "map", "show", path)
    path.unlink()
    write_map_file(path, MapFile("agent", "r0.1", ()))
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    assert "is truncated" in complaint(capfd, "map", "show", path)
    path.write_bytes(whole[:20] + b"\0" + whole[21:])
    assert "is damaged" in complaint(capfd, "map", "show", path)


def test_a_name_of_a_file_controls_no_terminal(tmp_path, capfd):
    path = tmp_path / "a\x1b[31mred\x07\x9b2J\u202e.mapweave"
    path.write_bytes(b"garbage")
    said = complaint(capfd, "map", "show", path)
    assert "red" in said and "is neither a map file" in said
    assert all(line.isprintable() for line in said.splitlines())


@pytest.mark.parametrize("pipe", [False, True])
def test_endless_input_is_not_read(tmp_path, capfd, pipe):
    path = tmp_path / "pipe" if pipe else Path("/dev/zero")
    if pipe:
        os.mkfifo(path)
    for command in (
        ("map", "show", path), ("map", "export", path, "--format", "tum", "-o", tmp_path / "x"),
        ("map", "merge", path, "-o", tmp_path / "x"), ("map", "import", path, "-o", tmp_path / "x"),
        ("server", "--settings", path),
    ):  # fmt: skip
        assert "not a regular file" in complaint(capfd, *command)


def test_a_map_with_singular_and_huge_covariances_is_solved(tmp_path):
    """Covariances are bounded when they are written, so no pose is left without one."""
    changes = []
    for number in (1, 3, 5):
        here = PoseGaussian(Pose2(number, 0, 0), np.eye(3) * 1e-4)
        camera = Camera(160, 120, 150, 150, 80, 60, 0.3)
        nothing = Landmarks.empty()
        changes.append(NodePut(Node(NodeId("r0", 1, number), 0, here, camera, nothing)))
    v = np.array([1.0, -2.0, 0.5])
    for a, b in ((1, 3), (3, 5)):
        moved = PoseGaussian(Pose2(2, 0, 0), np.outer(v, v) * 1e11)
        ends = NodeId("r0", 1, a), NodeId("r0", 1, b)
        changes.append(EdgePut(Edge(NodeId("r0", 1, a + 1), *ends, moved, EdgeKind.MAPPED)))
    path = tmp_path / "odd.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", tuple(changes)))
    out = tmp_path / "map.g2o"
    assert main(["map", "export", str(path), "--format", "g2o", "-o", str(out)]) == 0
    assert out.read_text().count("VERTEX_SE2") == 3


def test_settings(tmp_path, capfd, recording):
    path = tmp_path / "robot.toml"
    for command in (
        ["agent", "r0"], ["server"], ["sim", "run", "office"], ["sim", "serve", "office"],
        ["replay", recording, "--offline"],
    ):  # fmt: skip
        assert "no such file" in complaint(capfd, *command, "--settings", path.with_name("none.toml"))
        path.write_text("[netwrok]")
        assert "did you mean 'network'?" in complaint(capfd, *command, "--settings", path)
        path.write_text("[network")
        assert "robot.toml" in complaint(capfd, *command, "--settings", path)
        output = complaint(capfd, *command, "--settings", tmp_path)
        assert output.count(str(tmp_path)) == 1 and "Errno" not in output


def test_recordings(tmp_path, capfd, recording):
    assert "no such folder" in complaint(capfd, "replay", tmp_path / "nothing")
    assert "it must describe robot 'a'" in complaint(capfd, "replay", recording, "--robot", "a")
    (recording / "camera.toml").unlink()
    assert "camera's intrinsics" in complaint(capfd, "replay", recording)


@pytest.mark.parametrize(("name", "content", "words"), [
    ("images/1.png", b"\x89PNG\r\n\x1a\n" + b"\0" * 50, "1.png: not an image that can be read"),
    ("odometry.csv", b"forward_m,turn_rad\n0,0\n0,0\n0,fa\n", "line 4: turn_rad"),
])  # fmt: skip
def test_a_damaged_recording_is_mapped_as_far_as_it_can_be_read(
    name, content, words, tmp_path, capfd, recording
):
    (recording / name).write_bytes(content)
    arguments = ["replay", recording, "--offline", "--data", tmp_path / "data", "--epoch", 1]
    assert main([str(a) for a in arguments]) == 1
    output = capfd.readouterr().err.splitlines()
    (line,) = [line for line in output if line.startswith("mapweave: ")]
    assert words in line
    assert output[-1] == line
    assert not any("Traceback" in line for line in output)
    assert (tmp_path / "data" / "walk.1.mapweave").exists(), "what was mapped is kept"


def test_a_recording_with_a_long_name_is_mapped_under_a_shorter_one(recording, tmp_path):
    long = recording.rename(tmp_path / f"-{'Walk ' * 9}")
    assert main(["replay", str(long), "--offline", "--data", str(tmp_path / "data")]) == 0
    (path,) = (tmp_path / "data").glob("*.mapweave")
    assert path.name == f"{('walk-' * 9)[:32]}.1.mapweave"


def test_a_bag_or_a_video_cannot_be_scored(tmp_path, capfd):
    file = tmp_path / "walk.mcap"
    file.write_bytes(b"")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    for what in ("relocalize", "merge"):
        assert "bags and videos cannot be scored; give a folder" in complaint(capfd, "eval", what, file)
        assert "scored" in complaint(capfd, "eval", what, tmp_path / "bag")


def test_ffmpeg_prints_nothing_beside_the_one_line(tmp_path):
    """In a process of its own: OpenCV reads how much it shall say when it is imported."""
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 5.0, (64, 48), isColor=True)
    for k in range(9):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    path.write_bytes(path.read_bytes()[:-300])
    (line,) = mapweave("info", path).stderr.splitlines()
    assert "an MP4 that was cut off has lost its index" in line


def test_places_that_cannot_be_written(tmp_path, capfd, recording, closed):
    taken = tmp_path / "taken"
    taken.write_text("a file where a folder should be")
    for folder, words in ((taken, "is a file; give a folder"), (taken / "in" / "it", "is a file")):
        assert words in complaint(capfd, "replay", recording, "--offline", "--data", folder)
        assert words in complaint(capfd, "server", "--listen", closed, "--data", folder)
        assert words in complaint(capfd, "demo", "--out", folder)
        for command in (
            ["sim", "batch", "office"],
            ["eval", "relocalize", recording],
            ["eval", "merge", recording],
        ):
            output = complaint(capfd, *command, "--out", folder)
            assert f"{taken}: is a file; give a folder" in output, "before anything is measured"
    path = tmp_path / "a.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", one_node()))
    assert str(taken) in complaint(capfd, "map", "show", path, "--out", taken / "a.png")


def one_node():
    """A map of one place."""
    camera = Camera(64, 48, 60, 60, 32, 24, 0.3)
    here = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)
    return (NodePut(Node(NodeId("r0", 1, 1), 0, here, camera, Landmarks.empty())),)


def test_a_recording_offline_is_mapped_without_a_session(recording, tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise AssertionError("a session was opened")

    monkeypatch.setattr("mapweave.wire.zenoh_bus.ZenohBus.__init__", refuse)
    data = tmp_path / "data"
    assert main(["replay", str(recording), "--data", str(data), "--offline"]) == 0
    stamps = [line.split()[0] for line in (data / "walk.1.tum").read_text().splitlines() if line[0] != "#"]
    assert stamps == ["0.000000000", "0.100000000", "0.200000000"], "every frame, localized or not"


def test_a_replay_that_is_interrupted_says_how_far_it_came(recording, tmp_path, capfd, monkeypatch):
    """A script must not take a part of a map for the whole."""
    stop, sense = threading.Event(), Replay.sense

    def sense_and_stop(self):
        stop.set()
        return sense(self)

    monkeypatch.setattr("mapweave.commands.replay.stop_on_signals", lambda: stop)
    monkeypatch.setattr(Replay, "sense", sense_and_stop)
    data = tmp_path / "data"
    assert main(["replay", str(recording), "--data", str(data), "--offline"]) == INTERRUPTED
    *_, line = capfd.readouterr().err.splitlines()
    assert line == "mapweave: interrupted after 1 of 3 images; what is mapped of them is kept"
    assert (data / "walk.1.mapweave").exists()


def test_a_recording_without_a_server_is_mapped_all_the_same(recording, tmp_path, capfd, closed):
    data = tmp_path / "data"
    arguments = ["replay", recording, "--data", data, "--name", "r0", "--epoch", 1, "--offline"]
    assert main([str(a) for a in arguments]) == 0
    words = " ".join(capfd.readouterr().err.split())
    assert "0 nodes and 0 edges in" in words and "no nodes yet: only 0 features in view" in words
    assert main(["map", "show", str(data / "r0.1.mapweave"), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["nodes"] == 0
