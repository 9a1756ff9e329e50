"""Depths refined by drives: nearer to the truth, with honest sigmas, sent where it pays."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave import Camera, HybridMap, NodeId, Odometry, Pose2, PoseGaussian
from mapweave.agent.edge_measurement import landmark_refinement
from mapweave.agent.edge_measurement.landmark_refinement import LandmarkRefinement, refined
from mapweave.agent.ekf.localization_filter import LocalizationFilter
from mapweave.agent.ekf.localization_state import LocalizationState
from mapweave.agent.localization.fix import Fix
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.node import CODE_BYTES, Landmarks, Node
from mapweave.wire.codec import decode_body, encode_body

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
A, B = NodeId("r0", 1, 1), NodeId("r0", 1, 2)
AXLE, NOISE, PIXEL = 0.24, 0.02, 0.7
HERE = PoseGaussian(Pose2(), np.diag([1e-4, 1e-4, 1e-5]))
DEPTHS = np.linspace(2.0, 4.0, 20)


def landmarks(depths: np.ndarray, sigmas: np.ndarray, pixels: np.ndarray | None = None) -> Landmarks:
    n = len(depths)
    pixels = np.column_stack([np.linspace(10, 300, n), np.full(n, 80.0)]) if pixels is None else pixels
    return Landmarks(
        pixels.astype(np.float32), np.zeros((n, CODE_BYTES), np.uint8), depths.astype(np.float32),
        sigmas.astype(np.float32),
    )  # fmt: skip


def drive(rng: np.random.Generator, node: Landmarks, true: np.ndarray) -> LocalizationFilter:
    """60 images of points (N, 3) m while the robot drives about a node."""
    pose = Pose2(*(rng.normal(size=3) * (0.4, 0.2, 0.15)))
    sigmas = np.array([0.1, 0.1, 0.05])
    prior = PoseGaussian(pose @ Pose2.from_vector(sigmas * rng.normal(size=3)), np.diag(sigmas**2))
    ids = np.arange(len(true))
    points, covariances = node.points_in_robot(CAMERA), node.covariances_in_robot(CAMERA)
    one = LocalizationFilter(CAMERA, AXLE, NOISE, prior, ids, points, covariances)
    phase = rng.uniform(0, math.tau)
    for k in range(60):
        result = Odometry(0.03 * math.sin(0.1 * k + phase), 0.012 * math.cos(0.08 * k))
        wheels = result.forward + 0.5 * AXLE * result.turn * np.array([1.0, -1.0])
        right, left = wheels * (1 + NOISE * rng.normal(size=2))
        pose = pose @ Odometry((right + left) / 2, (right - left) / AXLE).motion()
        seen = CAMERA.project(pose.inverse().apply(true)) + PIXEL * rng.normal(size=(len(true), 2))
        seen[~CAMERA.contains(seen)] = np.nan
        one.predict(result)
        one.update(ids, seen)
    return one


@pytest.mark.slow
def test_four_drives_make_depths_better_and_never_too_sure(monkeypatch):
    """Each drive begins with the refined node of the drive before: one depth a landmark.

    With the filter's own variances the mean of the squared normalised errors is 1.5 after four drives.
    """
    for name, value in {"LEAST": 1, "SHARE": 1.0, "FLOOR": (0.0, 0.0)}.items():
        monkeypatch.setattr(landmark_refinement, name, value)
    errors: list[list[float]] = [[] for _ in range(5)]
    nees: list[list[float]] = [[] for _ in range(5)]
    for seed in range(100, 112):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(8, 25))
        true_depths, exact = rng.uniform(1.5, 5.0, n), rng.uniform((20, 20), (300, 220), (n, 2))
        true = CAMERA.back_project(exact, true_depths)
        share = rng.uniform(0.02, 0.08, n)
        depths = true_depths / (1 + share * rng.normal(size=n))
        node = landmarks(depths, share * depths**2 / true_depths, exact + PIXEL * rng.normal(size=(n, 2)))
        for count in range(5):
            off = node.depths - true_depths
            errors[count].append(float(np.sqrt(np.mean(off**2))))
            nees[count].append(float(np.mean((off / node.depth_sigmas) ** 2)))
            learned = drive(rng, node, true) if count < 4 else None
            if learned is not None and learned.healthy:
                node = refined(node, *learned.state.depths()) or node
    medians = [float(np.median(error)) for error in errors]
    assert medians[1] < 0.7 * medians[0] and medians[4] < 0.5 * medians[0]
    assert all(np.mean(error) < 1.0 for error in nees)


def test_independent_depth_errors_are_no_smaller_than_joint_ones():
    """Their covariance less the joint one of the filter is positive: for any weights of the landmarks."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(33, 33))
    rays = np.column_stack([rng.normal(size=(10, 2)), rng.uniform(0.2, 0.6, 10)])
    state = LocalizationState(np.zeros(3), rays, rays, root @ root.T * 1e-4)
    depths, sigmas = state.depths()
    assert depths == pytest.approx(1 / rays[:, 2])
    by_w = np.diag(depths**2)
    joint = by_w @ state.covariance[5::3, 5::3] @ by_w
    assert np.linalg.eigvalsh(np.diag(sigmas**2) - joint)[0] > -1e-12
    assert (sigmas**2 >= np.diag(joint)).all()


def test_depths_that_are_known_no_better_are_left_as_they_are():
    mapped = landmarks(DEPTHS, 0.1 * DEPTHS)
    sigmas = 0.1 * DEPTHS
    sigmas[:6] = 0.02
    better = refined(mapped, DEPTHS + 0.05, sigmas)
    assert better is not None
    assert better.depths[:6] == pytest.approx(DEPTHS[:6] + 0.05) and (better.depth_sigmas[:6] < 0.1).all()
    assert (better.depth_sigmas[:6] > 0.02).all(), "tracks err alike, which no filter knows"
    assert np.array_equal(better.depths[6:], mapped.depths[6:])
    assert np.array_equal(better.depth_sigmas[6:], mapped.depth_sigmas[6:])
    assert better.codes is mapped.codes and better.pixels is mapped.pixels


@pytest.mark.parametrize("trouble", ["few", "elsewhere", "nothing"])
def test_too_small_or_contradicting_refinements_are_not_sent(trouble):
    mapped, sigmas, depths = landmarks(DEPTHS, 0.1 * DEPTHS), np.full(20, 0.02), DEPTHS.copy()
    if trouble == "few":
        depths[4:] = sigmas[4:] = np.nan
    if trouble == "elsewhere":
        depths *= 1.5
    if trouble == "nothing":
        depths[:] = sigmas[:] = np.nan
    assert refined(mapped, depths, sigmas) is None


class Teacher(NodeLocalizer):
    """Has learned all depths of a node."""

    def __init__(self, node: Node) -> None:
        self.node = node

    @property
    def in_sight(self) -> bool:
        return True

    def depths(self) -> tuple[np.ndarray, np.ndarray]:
        return DEPTHS.copy(), np.full(len(DEPTHS), 0.02)


def test_a_node_is_refined_once_a_drive_when_the_robot_leaves_it():
    nodes = [Node(item, 7, HERE, CAMERA, landmarks(DEPTHS * 1.05, 0.1 * DEPTHS)) for item in (A, B)]
    foreign = replace(nodes[0], id=NodeId("r1", 1, 1))
    refinement = LandmarkRefinement(HybridMap(map(NodePut, nodes)))
    fixes = [Fix(node.id, HERE, Teacher(node)) for node in (*nodes, foreign)]
    assert refinement.see(fixes[0]) is None and refinement.see(fixes[0]) is None
    result = refinement.see(fixes[1])
    assert result is not None and result.id == A and result.stamp_ns == 7
    # On the grid on which it is sent: off by a sixth of their sigmas at most, and equal for all receivers.
    assert (np.abs(result.landmarks.depths - DEPTHS) <= result.landmarks.depth_sigmas / 5.5).all()
    sent = decode_body(encode_body(NodePut(result)))
    assert isinstance(sent, NodePut)
    for name in ("pixels", "depths", "depth_sigmas"):
        assert np.array_equal(getattr(sent.node.landmarks, name), getattr(result.landmarks, name))
    assert refinement.see(fixes[0]) is not None, "B is left"
    assert refinement.see(fixes[2]) is None, "A was known before"
    assert refinement.see(None) is None, "another robot's node is not its own to mend"
