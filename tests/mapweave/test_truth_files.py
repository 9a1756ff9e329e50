"""True poses as benchmarks publish them, written by hand: a curve of a camera that looks ahead."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.agent.recordings.pose_files import read_poses
from mapweave.cli import main
from mapweave.evaluation.truth_files import read_truth, truth_beside
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Pose2
from tests.agent.conftest import PhotoWalls
from tests.recordings import steps, write_folder

WAY = [Pose2(0.3 * k, 0.02 * k * k, 2.9 + 0.1 * k) for k in range(8)]
"""Headings pass half a turn."""
BEGUN_NS = 1_403_636_579_763_555_584
TRUE = np.array([pose.vector for pose in WAY])


def optical(heading: float) -> np.ndarray:
    """(3, 3) world_from_camera: x right, y down, z ahead; the world's z is up."""
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])


def quaternion(rotation: np.ndarray) -> list[float]:
    """X, y, z, w by Rodrigues' vector."""
    vector = cv2.Rodrigues(rotation)[0][:, 0]
    half = np.linalg.norm(vector) / 2
    return [*(vector / (2 * half) * math.sin(half)).tolist(), math.cos(half)]


def write_tum(path: Path, pitch: float = 0.0) -> None:
    rows = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for k, pose in enumerate(WAY):
        tipped = optical(pose.heading) @ cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0]
        q = " ".join(f"{value:.6f}" for value in quaternion(tipped))
        rows.append(f"{k / 10 + 1.4e9:.4f} {pose.x} {pose.y} 1.5 {q}")
    path.write_text("\n".join(rows) + "\n")


def write_euroc(path: Path) -> None:
    """The IMU's x is up, its z ahead. Velocity and biases follow."""
    path.parent.mkdir(parents=True)
    rows = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    ]
    for k, pose in enumerate(WAY):
        upright = optical(pose.heading)
        imu = np.column_stack([-upright[:, 1], upright[:, 0], upright[:, 2]])
        x, y, z, w = quaternion(imu)
        rows.append(f"{BEGUN_NS + k * 10**8},{pose.x},{pose.y},1.0,{w},{x},{y},{z}" + ",0.1" * 9)
    path.write_text("\r\n".join(rows) + "\r\n")


def write_kitti(dataset: Path) -> Path:
    """A sequence, and its poses in a folder beside. The world is the first camera's: x right, y down."""
    (sequence := dataset / "sequences" / "03").mkdir(parents=True)
    (dataset / "poses").mkdir()
    (sequence / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(len(WAY))))
    rows = []
    for pose in WAY:
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        matrix = [c, 0, -s, -pose.y, 0, 1, 0, 0.3, s, 0, c, pose.x]
        rows.append(" ".join(f"{value:e}" for value in matrix))
    (dataset / "poses" / "03.txt").write_text("\n".join(rows) + "\n")
    return sequence


def check(poses: np.ndarray, within: float = 1e-5) -> None:
    assert poses[:, :2] == pytest.approx(TRUE[:, :2], abs=within)
    assert np.exp(1j * poses[:, 2]) == pytest.approx(np.exp(1j * TRUE[:, 2]), abs=within)


@pytest.mark.parametrize("pitch", [0.0, -0.45, 0.45])
def test_headings_of_a_camera_are_where_it_looks(pitch: float, tmp_path):
    """That of x was taken, which is to the right: every metre was 2 m off."""
    write_tum(tmp_path / "groundtruth.txt", pitch)
    check(read_poses(tmp_path / "groundtruth.txt").poses)
    (tmp_path / "rgb.txt").touch()
    assert truth_beside(tmp_path) == tmp_path / "groundtruth.txt"
    stamps, poses = read_truth(tmp_path / "groundtruth.txt", tmp_path)
    check(poses)
    assert stamps[0] == 1_400_000_000_000_000_000


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_poses_in_the_frame_of_the_first_image_are_turned(turn: float, tmp_path):
    """As visual odometry writes them: the way to the side was taken for that ahead, without a word."""
    way = [Pose2()]
    for _ in range(20):
        way.append(way[-1] @ Pose2(0.5, 0.0, turn))
    rows = []
    for k, pose in enumerate(way):
        half = -pose.heading / 2
        rows.append(f"{k / 10} {-pose.y} 0.02 {pose.x} 0 {math.sin(half)} 0 {math.cos(half)}")
    (tmp_path / "camera.txt").write_text("\n".join(rows) + "\n")
    read = read_poses(tmp_path / "camera.txt")
    expected = np.array([pose.vector for pose in way])
    assert read.poses[:, :2] == pytest.approx(expected[:, :2], abs=1e-9)
    assert np.exp(1j * read.poses[:, 2]) == pytest.approx(np.exp(1j * expected[:, 2]), abs=1e-9)
    assert "turned until z is up" in read.notes[0]


def test_true_poses_of_euroc_are_read_with_their_nanoseconds(tmp_path):
    path = tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    write_euroc(path)
    assert truth_beside(tmp_path) == path
    stamps, poses = read_truth(path, tmp_path)
    check(poses)
    assert stamps.tolist() == [BEGUN_NS + k * 10**8 for k in range(len(WAY))]


def test_true_poses_of_kitti_have_the_times_of_the_sequence(tmp_path, monkeypatch):
    sequence = write_kitti(tmp_path)
    path = truth_beside(sequence)
    assert path == tmp_path / "poses" / "03.txt"
    stamps, poses = read_truth(path, sequence)
    check(poses)
    assert stamps.tolist() == [k * 10**8 for k in range(len(WAY))]
    monkeypatch.chdir(sequence)
    assert truth_beside(Path()) == path
    (sequence / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(DeviceError, match="8 poses for the 2 times of"):
        read_truth(path, sequence)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n1,2,3,4\n", "has no orientations"),
        ("#timestamp,x,y,z,w,x,y,z\n1,2,3,4,5,6,7,no\n", "could not convert"),
        ("#timestamp,x,y,z,w,x,y,z\n1.5,2,3,4,1,0,0,0\n", "invalid literal"),
        ("#timestamp,x,y,z,w,x,y,z\n2,2,3,4,1,0,0,0\n1,2,3,4,1,0,0,0\n", "must ascend"),
        ("#timestamp,x,y,z,w,x,y,z\n2,nan,3,4,1,0,0,0\n", "must be finite"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0\n", "inhomogeneous"),
        ("1 2 3\n", "a truth is truth.csv, TUM's"),
    ],
)
def test_wrong_truths_are_refused_in_one_line(text: str, words: str, tmp_path):
    path = tmp_path / "truth.txt"
    path.write_text(text)
    with pytest.raises(DeviceError, match=words) as caught:
        read_truth(path, tmp_path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_sequence_of_kitti_is_scored_by_the_poses_beside_it(tmp_path, capfd):
    """As exact as by a truth.csv."""
    walls, sequence = PhotoWalls(), tmp_path / "sequences" / "07"
    way = [Pose2(0.025 * k) for k in range(30)]
    write_folder(sequence, map(walls.render, way), steps(way, 1.03), timed=True, truth=way)
    command = ["eval", "replay", str(sequence), "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 0
    first = capfd.readouterr()
    (sequence / "truth.csv").unlink()
    (tmp_path / "poses").mkdir()
    rows = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {pose.x}\n" for pose in way)
    (tmp_path / "poses" / "07.txt").write_text(rows)
    assert main(command) == 0
    second = capfd.readouterr()
    by_csv, by_kitti = (json.loads(one.out.splitlines()[-1]) for one in (first, second))
    assert by_csv["truth"] and by_csv == by_kitti
    other = tmp_path / "other.txt"
    other.write_text("".join(f"{9e8 + k} 0 0 0 0 0 0 1\n" for k in range(9)))
    assert main([*command, "--truth", str(other)]) == 0
    third = capfd.readouterr()
    assert not json.loads(third.out.splitlines()[-1])["truth"]
    assert "of another clock?" in " ".join((third.out + third.err).split())
