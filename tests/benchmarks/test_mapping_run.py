"""The mapping run from the simulator's camera: figures, pictures, and the truth that it is judged by."""

import json
import math
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.images.surface_points import Surfaces
from benchmarks.mapping_run.benchmark import main, notes
from benchmarks.mapping_run.scene import MappingDrive, RunTick, drive
from benchmarks.mapping_run.score import LastKnown, figures, landmark_nees, reprojection_errors, track_errors
from mapweave import Odometry, Pose2, PoseGaussian
from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.sim.camera import WEBCAM
from mapweave.sim.robots import RobotSetup
from mapweave.sim.world import Panel
from mapweave.sim.worlds.catalog import make_world

PICTURES = ("fig7.png", "fig8.png", "landmarks.png", "map.png", "view.png")


@pytest.fixture(scope="module")
def run() -> MappingDrive:
    """A little more than once back and forth."""
    return drive(3, "arena", "line", 120)


@pytest.mark.slow
def test_the_command_draws_and_prints(tmp_path, monkeypatch, capsys):
    """One short run: its pictures, and its last line for scripts."""
    out = tmp_path / "a" / "b"
    arguments = ["--steps", "40", "--runs", "line", "--seed", "2", "--out", str(out), "--json"]
    monkeypatch.setattr(sys, "argv", ["mapping_run", *arguments])
    main()
    values = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert values["seed"] == 2
    assert values["abandoned"] == {"line": ""}
    assert values["seconds"] == {"line": 4.0}
    for key in ("pose_error_m", "wheels_error_m", "landmark_rmse_m", "nees_pose", "step_ms"):
        assert math.isfinite(values[key]["line"])
    for name in PICTURES:
        image = cv2.imread(str(out / name))
        assert image.shape[0] > 300
        assert image.std() > 5.0


def test_mismatched_comparisons_are_reported():
    seen: dict[str, float | None] = {"person_in_view_s": 3.0, "landmarks_left": 9.0}
    unseen: dict[str, float | None] = {"person_in_view_s": 0.0, "landmarks_left": 0.0}
    assert notes({"line": unseen | {"landmarks_left": 1.0}, "person": seen}, {"line": "", "person": ""}) == []
    result = notes({"line": seen, "person": unseen}, {"line": "carried off", "person": ""})
    assert [line.split(":")[0] for line in result] == ["line", "person", "person"]
    assert "carried off" in result[0]
    assert "no person came into view" in result[1]
    assert "no landmark was left" in result[2]


@pytest.mark.slow
def test_a_run_is_near_the_truth(run: MappingDrive):
    """Bounds with room for chance: `python -m benchmarks.mapping_run` measures the figures."""
    result = figures(run)
    assert not run.given_up
    assert result["reach_m"] == pytest.approx(0.6, abs=0.05)
    assert result["pose_rmse_m"] < 0.02
    assert result["pose_error_deg"] < 0.5
    assert result["pose_rmse_deg"] < result["wheels_rmse_deg"]
    assert result["converged_share"] > 0.3
    assert result["depth_error_percent_median"] < 10.0
    assert result["track_error_px"] < 2.0
    assert result["track_length_max"] == 121.0
    assert result["landmarks_left"] <= result["landmarks"] <= result["tracks"]


@pytest.mark.slow
def test_a_person_in_the_view_changes_nothing_else():
    alone, passed = drive(2, "arena", "line", 60), drive(2, "arena", "line", 60, person=True)
    bearings = np.array([m.person for m in passed.moments])
    assert np.isfinite(bearings).sum() > 5
    assert all(math.isnan(m.person) for m in alone.moments)
    first = int(np.isfinite(bearings).argmax())
    # A landmark's edge comes into view before its middle does.
    assert alone.moments[first - 8].pose.mean == passed.moments[first - 8].pose.mean
    assert len(passed.moments[-1].ids) < len(alone.moments[-1].ids)
    assert figures(passed)["person_in_view_s"] == pytest.approx(0.1 * np.isfinite(bearings).sum())


def test_the_same_seed_gives_the_same_run_and_another_seed_another(run: MappingDrive):
    again, other = drive(3, "arena", "line", 20), drive(4, "arena", "line", 20)
    assert again.moments[20].pose.mean == run.moments[20].pose.mean
    np.testing.assert_array_equal(again.images[0], run.images[0])
    assert other.world_from_anchor != run.world_from_anchor


def test_true_points_are_on_the_surfaces_of_the_picture(run: MappingDrive):
    """A true point, seen from the end of the way, shows what the anchor showed around it: the truth moves
    with the picture as the robot does, independent of trackers and filters.
    """
    camera = run.robot.camera
    number = max(range(len(run.moments)), key=lambda k: run.moments[k].true.x if k in run.images else -1.0)
    assert run.moments[number].true.x > 0.5
    before, after = run.images[0], run.images[number]
    there = camera.project(run.moments[number].true.inverse().apply(run.points))
    here = camera.project(run.points)
    scale = run.points[:, 0] / (run.points[:, 0] - run.moments[number].true.x)
    likeness = []
    for k in np.flatnonzero(run.flat & camera.contains(here, 16.0) & camera.contains(there, 16.0)):
        patch = cv2.getRectSubPix(before, (15, 15), here[k].astype(np.float32).tolist())
        grown = cv2.resize(after, None, fx=1 / scale[k], fy=1 / scale[k], interpolation=cv2.INTER_AREA)
        centre = ((there[k] + 0.5) / scale[k] - 0.5).astype(np.float32)
        other = cv2.getRectSubPix(grown, (15, 15), centre.tolist())
        likeness.append(float(np.corrcoef(patch.ravel(), other.ravel())[0, 1]))
    assert len(likeness) > 10
    assert np.median(likeness) > 0.9


def test_rays_agree_with_another_solution():
    """Against a solution of one system a panel and ray."""
    world = make_world("office", 5)
    surfaces, camera = Surfaces(world), WEBCAM
    rng = np.random.default_rng(0)
    pose = world.plan.random_free_pose(rng, 0.3)
    pixels = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (60, 2))
    seen = surfaces.see(pose, camera, pixels)
    eye = pose.apply(np.array([camera.mount_forward, 0.0, camera.mount_height]))
    met = 0
    for pixel, point, depth in zip(pixels, seen.points, seen.depths, strict=True):
        ray = pose.apply(camera.back_project(pixel, np.array(1.0))) - eye
        hits = [hit for panel in world.panels if (hit := _meets(panel, eye, ray)) is not None]
        nearest = min(hits, default=math.inf)
        assert depth == pytest.approx(nearest, rel=1e-9)
        if hits:
            met += 1
            np.testing.assert_allclose(point, eye + nearest * ray, atol=1e-9)
    assert met > 40


def _meets(panel: Panel, eye: np.ndarray, ray: np.ndarray) -> float | None:
    """How far along a ray it meets a panel's front, in lengths of the ray."""
    if ray @ np.cross(panel.along, panel.down) <= 0:
        return None
    depth, p, q = np.linalg.solve(np.column_stack([ray, -panel.along, -panel.down]), panel.corner - eye)
    return float(depth) if 0 <= p <= 1 and 0 <= q <= 1 and depth > 0.03 else None


def test_a_patch_across_an_edge_is_no_point():
    """A box before a wall: its middle is one surface, its edge is two."""
    world = make_world("arena", 0, boxes=1)
    box = world.plan.furniture[0]
    face = Pose2(box.x, box.y, box.heading) @ Pose2(box.length / 2 + 1.0, 0.0, math.pi)
    edge = WEBCAM.fx * box.width / 2 / 1.0
    row = WEBCAM.cy + 40.0
    pixels = np.array([[WEBCAM.cx, row], [WEBCAM.cx + edge, row], [WEBCAM.cx - edge, row]])
    assert Surfaces(world).flat(face, WEBCAM, pixels).tolist() == [True, False, False]


def test_the_score_of_a_known_error_is_that_error():
    """A robot that is 3 cm and 2 deg off, with landmarks whose errors are drawn from the covariance."""
    rng = np.random.default_rng(1)
    robot = RobotSetup("r0").describe()
    camera, n = robot.camera, 4000
    rays = np.column_stack([rng.uniform(-0.5, 0.5, n), rng.uniform(-0.4, 0.4, n), rng.uniform(0.2, 0.6, n)])
    covariance = np.diag([1e-6, 1e-6, 4e-4])
    estimated = rays + rng.normal(size=(n, 3)) * np.sqrt(np.diag(covariance))
    ids = np.arange(n)
    covariances = np.broadcast_to(covariance, (n, 3, 3))
    known = LandmarkEstimates.of_rays(ids, estimated, covariances, camera)
    true = LandmarkEstimates.of_rays(ids, rays, covariances, camera)
    assert landmark_nees(known, true.points_in_robot, camera).mean() == pytest.approx(3.0, abs=0.15)
    at = Pose2(0.4, -0.1, 0.2)
    off = at @ Pose2(0.0, 0.03, math.radians(2.0))
    pixels = camera.project(true.points_in_robot) + np.array([0.3, -0.4])
    moment = RunTick(
        Odometry(0.0, 0.0), at, off, PoseGaussian.from_sigmas(off, 0.03, math.radians(2.0)), true,
        ids, pixels, True, math.nan, 1.0,
    )  # fmt: skip
    run = MappingDrive(
        "made", robot, make_world("arena", 0), Pose2(), ids, at.apply(true.points_in_robot), np.ones(n, bool),
        (moment, moment), {}, "",
    )  # fmt: skip
    result = figures(run)
    assert result["pose_error_m"] == pytest.approx(0.03)
    assert result["wheels_rmse_deg"] == pytest.approx(2.0)
    assert result["nees_pose"] == pytest.approx(2.0, rel=1e-3)
    assert result["track_error_px"] == pytest.approx(0.5)
    assert result["reprojection_px_median"] == pytest.approx(0.5)
    np.testing.assert_allclose(track_errors(run, moment), np.tile([0.3, -0.4], (n, 1)), atol=1e-9)
    np.testing.assert_allclose(reprojection_errors(run, moment)[0], [0.3, -0.4], atol=1e-9)
    expected = np.linalg.norm(off.apply(true.points_in_robot) - run.points, axis=1)
    np.testing.assert_allclose(LastKnown.of(run).errors, expected)
    # A landmark that is lost counts as it was known last.
    first = replace(moment, pose=PoseGaussian.from_sigmas(at, 0.1, 0.1))
    left = LandmarkEstimates(*(column[1:] for column in true))
    later = replace(moment, landmarks=left, ids=ids[1:], pixels=pixels[1:])
    errors = LastKnown.of(replace(run, moments=(first, later))).errors
    assert errors[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(errors[1:], expected[1:])
