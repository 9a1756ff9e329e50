"""Which drives are measurements, and how precise: for a robot whose pose is given, with noise."""

import math
from typing import Any

import numpy as np
import pytest

from mapweave import Camera, NodeId, Observation, Odometry, Pose2, PoseGaussian, RobotDescription
from mapweave.agent.edge_measurement import traverse
from mapweave.agent.edge_measurement.traverse import Traverse, TraverseRecorder
from mapweave.agent.localization.fix import Fix
from mapweave.agent.localization.node_localizer import NodeLocalizer

ROBOT = RobotDescription(Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3))
A, B, C = (NodeId("r0", 1, number) for number in (1, 2, 3))
NODES = {A: Pose2(), B: Pose2(1.5, 0.3, 0.4), C: Pose2(3.0, 0.3, -0.2)}
SIGMAS = np.array([0.01, 0.015, 0.006])
STEP = Odometry(0.02, 0.001)
CERTAIN = 16.27
"""99.9 % of chi-square with 3 degrees of freedom."""


class Landmarks(NodeLocalizer):
    """A node in sight, with so many landmarks; nothing is tracked."""

    def __init__(self, count: int) -> None:
        self.count = count

    @property
    def in_sight(self) -> bool:
        return True

    @property
    def visible(self) -> np.ndarray:
        return np.arange(self.count)


class Drive:
    """A robot on its way, whose wheels slip, after legs: what `by` takes."""

    def __init__(self, *legs: tuple[Any, ...], seed: int = 0, begin: Pose2 = NODES[A]) -> None:
        self.rng = np.random.default_rng(seed)
        self.recorder = TraverseRecorder(ROBOT)
        self.pose = begin
        self.measured: list[Traverse] = []
        for leg in legs:
            self.by(*leg)

    def by(self, node: NodeId | None, steps: int, odometry: Odometry = STEP, count: int = 12) -> None:
        """Drive some steps with a node's landmarks in sight; without any, by wheels alone."""
        landmarks = None if node is None else Landmarks(count)
        for _ in range(steps):
            wheels = np.array([-0.5, 0.5]) * ROBOT.axle * odometry.turn + odometry.forward
            left, right = wheels * (1 + ROBOT.wheel_noise * self.rng.normal(size=2))
            self.pose = self.pose @ Odometry((left + right) / 2, (right - left) / ROBOT.axle).motion()
            fix = Fix(A, PoseGaussian(Pose2(9.0), np.eye(3)))
            if node is not None:
                noise = Pose2.from_vector(self.rng.normal(0, SIGMAS))
                pose = PoseGaussian(NODES[node].inverse() @ self.pose @ noise, np.diag(SIGMAS**2))
                fix = Fix(node, pose, landmarks)
            self.see(fix, odometry)

    def see(self, fix: Fix | None, odometry: Odometry = STEP) -> None:
        traverse = self.recorder.see(fix, Observation(0, odometry))
        if traverse is not None:
            self.measured.append(traverse)

    @property
    def ends(self) -> list[tuple[NodeId, NodeId]]:
        return [(traverse.start, traverse.end) for traverse in self.measured]


def test_a_traverse_is_reported_when_the_next_node_is_reached():
    drive = Drive((A, 20), (B, 10))
    assert not drive.ends, "the next node is in sight, but far"
    drive.by(B, 60)
    assert drive.ends == [(A, B)]


def test_traverse_errors_match_the_covariance(monkeypatch):
    """The mean over 60 drives: no surer than it is right, and not much less sure either."""
    monkeypatch.setattr(traverse, "FLOOR", (0.0, 0.0))
    nees = []
    for seed in range(60):
        [measured] = Drive((A, 20), (None, 10), (B, 60), seed=seed).measured
        nees.append(measured.start_from_end.mahalanobis2(NODES[A].inverse() @ NODES[B]))
    assert 1.0 < np.mean(nees) < 4.0


def test_a_node_that_was_not_come_near_is_passed_over():
    drive = Drive((A, 20))
    drive.by(B, 5, count=7)
    drive.by(C, 130)
    [traverse] = drive.measured
    assert (traverse.start, traverse.end, traverse.landmarks) == (A, C, 7)
    assert traverse.start_from_end.mahalanobis2(NODES[A].inverse() @ NODES[C]) < CERTAIN


def test_without_a_node_nearby_no_traverse_begins():
    assert not Drive((A, 10), (B, 130), begin=Pose2(-0.8)).ends


@pytest.mark.parametrize(("steps", "ends"), [(20, [(A, B)]), (30, [])])
def test_a_gap_without_landmarks_must_be_short(steps, ends):
    assert Drive((A, 10), (None, steps), (B, 60)).ends == ends


def test_a_node_that_was_glimpsed_is_no_node():
    drive = Drive((A, 10), (B, 2), (C, 130))
    assert drive.ends == [(A, C)]
    assert drive.measured[0].start_from_end.mahalanobis2(NODES[A].inverse() @ NODES[C]) < CERTAIN


def test_a_robot_lost_in_between_may_have_been_carried():
    drive = Drive((A, 10))
    drive.see(None)
    drive.pose = Pose2(1.5, 0.1)
    drive.by(B, 10)
    assert not drive.ends
    drive.by(C, 100)
    assert drive.ends == [(B, C)], "from there on it measures again"


def test_a_detour_does_not_measure_the_straight_way():
    assert not Drive((A, 10), (B, 60, Odometry(0.05, 2 * math.pi / 60)), (B, 80)).ends


def test_imprecise_traverses_are_not_reported(monkeypatch):
    monkeypatch.setattr(traverse, "WIDEST", 0.015)
    assert not Drive((A, 20), (B, 60)).ends
