"""Estimates of a pose that are joined, and how certain one is."""

import numpy as np
import pytest

from mapweave.agent.localization.fix import joined, position_sigma
from mapweave.hybridmap.pose import Pose2, PoseGaussian

ASIDE = np.array([[9.0, 1.0, 0.0], [1.0, 49.0, -27.0], [0.0, -27.0, 16.0]]) * 1e-6
ALONG = np.array([[16.0, 0.0, 2.0], [0.0, 4.0, 1.0], [2.0, 1.0, 9.0]]) * 1e-6


def test_estimates_are_joined_as_by_least_squares():
    """Against the normal equations of both; at heading 0 poses are vectors."""
    a, b = Pose2(0.001, -0.004, 0.0), Pose2(-0.002, 0.003, -0.003)
    both = joined(PoseGaussian(a, ASIDE), PoseGaussian(b, ALONG))
    information = np.linalg.inv(ASIDE) + np.linalg.inv(ALONG)
    pulls = np.linalg.solve(ASIDE, a.vector) + np.linalg.solve(ALONG, b.vector)
    assert both.mean.vector == pytest.approx(np.linalg.solve(information, pulls), abs=1e-6)
    assert both.covariance == pytest.approx(np.linalg.inv(information), abs=1e-9)


def test_its_errors_are_as_large_as_it_says():
    """A thousand pairs of estimates of one pose, each off by its own covariance."""
    rng, true = np.random.default_rng(1), Pose2(0.7, -0.3, 2.0)
    squares = []
    for _ in range(1000):
        off = [rng.multivariate_normal(np.zeros(3), covariance) for covariance in (ASIDE, ALONG)]
        poses = [
            PoseGaussian(true @ Pose2(*d).inverse(), c) for d, c in zip(off, (ASIDE, ALONG), strict=True)
        ]
        squares.append(joined(*poses).mahalanobis2(true))
    assert np.mean(squares) == pytest.approx(3.0, abs=0.3)


def test_tracks_that_have_slid_are_not_believed():
    look, slid = PoseGaussian(Pose2(0.0, 0.02, 0.0), ASIDE), PoseGaussian(Pose2(0.03, 0.0, 0.02), ALONG)
    assert joined(look, slid) is look


def test_a_position_is_as_uncertain_as_in_its_worst_direction():
    turned = Pose2(0.0, 0.0, 0.6).rotation
    covariance = np.diag([0.0, 0.0, 1.0])
    covariance[:2, :2] = turned @ np.diag([0.003**2, 0.008**2]) @ turned.T
    assert position_sigma(PoseGaussian(Pose2(), covariance)) == pytest.approx(0.008)
