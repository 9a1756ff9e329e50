"""Looking closer, against the truth of a synthetic world; averages against an optimum found by search."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian, averaged
from mapweave.registration.pose_refinement import refine_pose
from mapweave.registration.recognition import RecognitionSettings, recognise
from synthetic.world import Sensing, room, take_node, take_view

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
SETTINGS = RecognitionSettings()
WORLD = room(0, 0, 5, 4, 700, np.random.default_rng(1))


def looks(pixel_sigma: float, count: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances of recognitions and of closer looks from the truth, m, and the latter's squared norm."""
    rng = np.random.default_rng(7)
    first, closer, squared = [], [], []
    node_sensing = Sensing(pixel_sigma=min(pixel_sigma, 0.1))
    for number in range(count):
        a = Pose2(*rng.uniform([1.5, 1.2, -3.1], [3.5, 2.8, 3.1]))
        b = a @ Pose2(*rng.uniform(-0.05, 0.05, 3))
        node = take_node(WORLD, NodeId("r0", 1, number), a, HERE, rng, node_sensing)
        view, _ = take_view(WORLD, b, rng, Sensing(pixel_sigma=pixel_sigma))
        recognition = recognise(node, view, SETTINGS, rng)
        if recognition is None:
            continue
        best, true = refine_pose(node, view, recognition, SETTINGS.pose), a.inverse() @ b
        first.append(recognition.node_from_robot.mean.distance(true))
        closer.append(best.mean.distance(true))
        squared.append(best.mahalanobis2(true))
    assert len(first) > 0.7 * count
    return np.array(first), np.array(closer), np.array(squared)


def test_sharp_pixels_give_a_smaller_covariance():
    first, closer, squared = looks(0.12)
    assert np.median(closer) < 0.9 * np.median(first)
    assert np.median(closer) < 0.003
    assert 0.5 < np.mean(squared) < 4.5, "3 is expected"


def test_the_noise_of_blurred_pixels_is_estimated():
    first, closer, squared = looks(1.0)
    assert np.median(closer) < 1.15 * np.median(first)
    assert np.mean(squared) < 4.5


def test_that_another_pose_may_be_the_true_one_stays_in_the_covariance():
    rng, a = np.random.default_rng(3), Pose2(2.5, 2.0, 0.3)
    node = take_node(WORLD, NodeId("r0", 1, 1), a, HERE, rng, Sensing(pixel_sigma=0.1))
    view, _ = take_view(WORLD, a @ Pose2(0.03, 0.02, 0.01), rng, Sensing(pixel_sigma=0.12))
    one = recognise(node, view, SETTINGS, rng)
    assert one is not None and not one.spread.any()
    spread = np.diag([0.04, 0.01, 0.0001])
    pose = PoseGaussian(one.node_from_robot.mean, one.node_from_robot.covariance + spread)
    of_two = replace(one, node_from_robot=pose, spread=spread)
    alone, both = (refine_pose(node, view, each, SETTINGS.pose) for each in (one, of_two))
    assert alone.covariance.trace() < one.node_from_robot.covariance.trace()
    assert np.allclose(both.covariance, alone.covariance + spread, rtol=1e-6, atol=1e-12)


def test_a_refinement_that_leaves_most_landmarks_out_is_not_taken():
    """Landmarks up to 100 m away, of which every third pixel is off by more than the others."""
    street, rng = room(0, 0, 100, 80, 3000, np.random.default_rng(1)), np.random.default_rng(7)
    first, closer = [], []
    for number in range(60):
        a = Pose2(50.0, 40.0, rng.uniform(-3.0, 3.0))
        b = a @ Pose2(*rng.uniform([-6.0, -0.3, -0.03], [6.0, 0.3, 0.03]))
        sensing = Sensing(pixel_sigma=0.3, reach=300.0, depth_share=0.1)
        node = take_node(street, NodeId("r0", 1, number), a, HERE, rng, sensing)
        view, _ = take_view(street, b, rng, Sensing(pixel_sigma=0.3, reach=300.0))
        blurred = rng.random(len(view)) < 0.35
        pixels = view.pixels + np.where(blurred[:, None], rng.normal(0.0, 1.5, view.pixels.shape), 0.0)
        view = replace(view, pixels=pixels.astype(np.float32))
        recognition = recognise(node, view, SETTINGS, rng)
        if recognition is None:
            continue
        best, true = refine_pose(node, view, recognition, SETTINGS.pose), a.inverse() @ b
        first.append(recognition.node_from_robot.mean.distance(true))
        closer.append(best.mean.distance(true))
    assert len(first) > 40
    assert np.max(closer) < 1.2 * np.max(first), "it was 2.2 times"


def test_an_average_is_where_the_likelihood_is_highest():
    rng = np.random.default_rng(3)
    middle = Pose2(0.4, -0.2, 3.1)
    poses = []
    for _ in range(4):
        root = rng.normal(0, 0.01, (3, 3))
        poses.append(PoseGaussian(middle @ Pose2(*rng.normal(0, 0.01, 3)), root @ root.T + 1e-6 * np.eye(3)))
    whole = averaged(poses)
    result = minimize(
        lambda v: sum(pose.mahalanobis2(middle @ Pose2.from_vector(v)) for pose in poses),
        np.zeros(3),
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 5000},
    )
    best = middle @ Pose2.from_vector(result.x)
    assert whole.mean.distance(best) < 2e-4
    assert abs(math.remainder(whole.mean.heading - best.heading, math.tau)) < 2e-4
    assert np.allclose(whole.covariance, np.mean([pose.covariance for pose in poses], axis=0))
    assert averaged(poses[:1]).mean.vector == pytest.approx(poses[0].mean.vector)
