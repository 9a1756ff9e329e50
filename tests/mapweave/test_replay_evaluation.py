"""`mapweave eval replay` against evo, and what it says of frames that were not used."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from mapweave.agent.calibration.correction import corrected, frame_change
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.calibration.report import Cause
from mapweave.agent.drive_geometry import Parameter
from mapweave.cli import main
from mapweave.evaluation.replaying import errors, rows
from mapweave.hybridmap.pose import Pose2
from tests.agent.conftest import PhotoWalls
from tests.mapweave.command_line import complaint
from tests.quick import first_quick
from tests.recordings import steps, write_folder


def trajectory(poses: np.ndarray) -> PoseTrajectory3D:
    half = poses[:, 2] / 2
    zero = np.zeros(len(poses))
    return PoseTrajectory3D(
        np.column_stack([poses[:, :2], zero]),
        np.column_stack([np.cos(half), zero, zero, np.sin(half)]),
        np.arange(len(poses), dtype=float),
    )


def test_errors_are_those_of_evo():
    """Steps of 0.25 m make a metre four frames, which evo can be asked for."""
    rng = np.random.default_rng(3)
    pose, rows = Pose2(2.0, 1.0, 0.4), []
    for _ in range(80):
        rows.append(pose.vector)
        pose = pose @ Pose2(0.25, 0.0, rng.normal(0.0, 0.1))
    true = np.array(rows)
    mine = np.array([(Pose2(5.0, -3.0, 2.0) @ Pose2.from_vector(row)).vector for row in true])
    mine += rng.normal(0.0, [0.03, 0.03, 0.01], mine.shape)
    ate, rpe, turn = errors(mine, true, np.zeros(len(true)))

    reference, estimate = trajectory(true), trajectory(mine)
    aligned = trajectory(mine)
    aligned.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    assert ate == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=0.01)
    for relation, measured in (
        (metrics.PoseRelation.translation_part, rpe), (metrics.PoseRelation.rotation_angle_deg, turn)
    ):  # fmt: skip
        relative = metrics.RPE(relation, 4, metrics.Unit.frames, all_pairs=True)
        relative.process_data((reference, estimate))
        assert measured == pytest.approx(relative.get_statistic(metrics.StatisticsType.rmse), rel=0.02)


def test_parts_are_aligned_one_by_one():
    """Two maps of a drive, each exact in a frame of its own, have no error."""
    true = np.array([[0.1 * k, 0.02 * k * k, 0.1 * k] for k in range(40)])
    moved = [Pose2(9.0, 9.0, 1.0) @ Pose2.from_vector(row) if k < 20 else Pose2.from_vector(row)
             for k, row in enumerate(true)]  # fmt: skip
    mine = np.array([pose.vector for pose in moved])
    ate, rpe, turn = errors(mine, true, np.repeat([0, 1], 20))
    assert ate == pytest.approx(0.0, abs=1e-9) and rpe == pytest.approx(0.0, abs=1e-9)
    assert turn == pytest.approx(0.0, abs=1e-6)
    assert errors(mine[:0], true[:0], np.zeros(0)) == (None, None, None)


def test_a_geometry_that_is_declared_wrongly_is_named(recording: Path, tmp_path, capfd, monkeypatch):
    """As `mapweave replay` does. What finds it is tested with the calibration."""
    begin = OnlineCalibration.__init__
    cause = Cause(Parameter.TURN_SCALE, 1.0, 1.1, 0.01, 10.0)

    def found(self: OnlineCalibration, *arguments: object, **named: object) -> None:
        begin(self, *arguments, **named)  # type: ignore[arg-type]
        self.causes.append(cause)

    monkeypatch.setattr(OnlineCalibration, "__init__", found)
    assert main(["eval", "replay", str(recording), "--out", str(tmp_path / "out")]) == 0
    assert str(cause) in " ".join(capfd.readouterr().err.split())


def test_a_recording_is_scored_and_its_trajectory_is_read_by_evo(tmp_path, capfd):
    """A drive towards two walls, whose odometry is 3 % long."""
    walls, folder, out = PhotoWalls(), tmp_path / "walk", tmp_path / "out"
    way = [Pose2(0.025 * k) for k in range(30)]
    write_folder(folder, map(walls.render, way), steps(way, 1.03), timed=True, truth=way)
    assert main(["eval", "replay", str(folder), "--out", str(out), "--json"]) == 0
    report = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert report["frames"] == 30 and report["maps"] == 1 and report["nodes"] >= 1
    assert str(report["frames"]) == "30"
    assert ("frames_used", f"{100 * report['frames_used']:g} %") in rows(report)
    used = round(report["frames_used"] * report["frames"])
    assert used >= 25 and used + sum(report["not_used"].values()) == 30
    # Alignment leaves of an error in proportion to the way its spread: 3 % of the way's standard deviation.
    spread = 0.03 * 0.025 * np.arange(30)[30 - used :].std()
    assert report["wheels_ate_m"] == pytest.approx(spread, rel=0.01, abs=1e-4)
    assert 0.0 <= report["ate_m"] < 1.5 * spread
    estimate = file_interface.read_tum_trajectory_file(out / "map0.tum")
    wheels = file_interface.read_tum_trajectory_file(out / "wheels.tum")
    assert (estimate.num_poses, wheels.num_poses) == (30, 30), "also those that were not used, by the wheels"
    matched, _ = sync.associate_trajectories(wheels, estimate)
    assert matched.num_poses == 30
    missing = tmp_path / "none.csv"
    assert f"{missing}: no such file" in complaint(capfd, "eval", "replay", folder, "--truth", missing)


def test_a_corrected_geometry_makes_no_jump_in_the_trajectories(tmp_path, capfd, monkeypatch):
    """In the middle of a drive the camera is found to be 0.4 m further ahead of the axle than declared.

    That it is found is tested with the calibration.
    """
    walls, folder, count, step = PhotoWalls(), tmp_path / "walk", 60, 0.02
    way = [Pose2(step * k) for k in range(count)]
    write_folder(folder, map(walls.render, way), steps(way))
    changed = list[OnlineCalibration]()

    def watch(self: OnlineCalibration, *arguments: object) -> tuple[Cause, ...]:
        if not changed:
            after = replace(self.geometry, forward=0.4)
            self._next, change = after, frame_change(self.geometry, after)
            self.pending = (*corrected(self.description, after), change)
            changed.append(self)
        return ()

    monkeypatch.setattr(OnlineCalibration, "watch", watch)
    for arguments, file in (
        (["eval", "replay", str(folder), "--out", str(tmp_path)], "map0.tum"),
        (["replay", str(folder), "--offline", "--data", str(tmp_path / "data")], "data/walk.1.tum"),
    ):
        changed.clear()
        assert main(arguments) == 0
        assert changed[0].geometry.forward == 0.4, "the episode has ended, and it is in use"
        poses = file_interface.read_tum_trajectory_file(tmp_path / file).positions_xyz
        assert np.diff(poses[:, 0]) == pytest.approx(np.full(count - 1, step), abs=0.01)


@pytest.mark.parametrize(
    ("times", "words"), first_quick([(-1.0, "the other way than the odometry"), (1.0, "")], 1)
)
def test_odometry_with_reversed_turns_is_named(times: float, words: str, tmp_path, capfd):
    """What else is named is tested with `OdometryConvention`."""
    walls, folder = PhotoWalls(), tmp_path / "walk"
    headings = 0.25 * np.sin(0.15 * np.arange(60))
    turns = times * np.diff(headings, prepend=0.0)
    images = (walls.render(Pose2(0.01 * k, 0.0, float(heading))) for k, heading in enumerate(headings))
    write_folder(folder, images, [(0.01 if k else 0.0, turn) for k, turn in enumerate(turns)])
    for arguments in (
        ["replay", str(folder), "--offline", "--data", str(tmp_path / "data")],
        ["eval", "replay", str(folder), "--out", str(tmp_path / "out")],
    ):
        assert main(arguments) == 0
        said = " ".join("".join(capfd.readouterr()).split())
        assert said.count(words or "the map is wrong") == (1 if words else 0)
