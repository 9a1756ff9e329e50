"""Gates against textbook formulas, one innovation at a time."""

import numpy as np
import pytest
from scipy.special import chdtri

from mapweave.agent.ekf.gating import one_point_consensus, pixel_gate, select_inliers
from mapweave.agent.ekf.innovations import leave_one_out, whiten


def joint(n: int, shared: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Innovations of one pixel each with an error that all share, and their covariance."""
    lever = rng.normal(size=(2 * n, 2)) * 0.2 + np.tile([[1.0, 0.0], [0.0, 0.3]], (n, 1))
    covariance = shared**2 * lever @ lever.T + np.eye(2 * n)
    return rng.multivariate_normal(np.zeros(2 * n), covariance).reshape(n, 2), covariance


@pytest.mark.parametrize("probability", [0.9, 0.99, 0.999])
def test_gate_is_the_chi_square_quantile(probability: float):
    assert pixel_gate(probability) == pytest.approx(chdtri(2, 1 - probability))


def test_leave_one_out_distances():
    rng = np.random.default_rng(0)
    innovations, s = joint(7, 5.0, rng)
    given_others = leave_one_out(innovations, whiten(s))
    for i in range(7):
        own = np.array([2 * i, 2 * i + 1])
        rest = np.delete(np.arange(14), own)
        r = innovations.ravel()
        gain = s[np.ix_(own, rest)] @ np.linalg.inv(s[np.ix_(rest, rest)])
        left, spread = r[own] - gain @ r[rest], s[np.ix_(own, own)] - gain @ s[np.ix_(rest, own)]
        assert given_others[i] == pytest.approx(left @ np.linalg.solve(spread, left))


def test_a_shared_error_is_no_outlier():
    rng = np.random.default_rng(1)
    gate = pixel_gate(0.999)
    kept = [select_inliers(*joint(20, 30.0, rng), gate)[0].mean() for _ in range(50)]
    assert np.mean(kept) > 0.99


def test_outliers_hidden_by_a_shared_error_are_found():
    rng = np.random.default_rng(2)
    gate = pixel_gate(0.999)
    for _ in range(30):
        innovations, s = joint(20, 30.0, rng)
        wrong = rng.permutation(20)[:8]
        # Too small to be seen alone beside the shared 30 px.
        angle = rng.uniform(0, 2 * np.pi, 8)
        innovations[wrong] += rng.uniform(12, 25, (8, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
        accepted, whitening, _ = select_inliers(innovations, s, gate)
        assert not accepted[wrong].any()
        assert accepted.sum() >= 11
        chosen = np.flatnonzero(np.repeat(accepted, 2))
        white = whitening @ s[np.ix_(chosen, chosen)] @ whitening.T
        np.testing.assert_allclose(white, np.eye(len(chosen)), atol=1e-8)


def test_consensus_is_that_of_the_best_single_landmark():
    """The vectorised hypotheses against one conditional distribution at a time."""
    rng = np.random.default_rng(3)
    innovations, s = joint(9, 10.0, rng)
    innovations[[1, 5, 6]] += [[15.0, 0.0], [0.0, -20.0], [-14.0, 9.0]]
    gate, best = pixel_gate(0.99), -1
    r = innovations.ravel()
    for j in range(9):
        jj = np.array([2 * j, 2 * j + 1])
        if r[jj] @ np.linalg.solve(s[np.ix_(jj, jj)], r[jj]) > gate:
            continue
        agree = 0
        for i in range(9):
            ii = np.array([2 * i, 2 * i + 1])
            gain = s[np.ix_(ii, jj)] @ np.linalg.inv(s[np.ix_(jj, jj)])
            left, spread = r[ii] - gain @ r[jj], s[np.ix_(ii, ii)] - gain @ s[np.ix_(jj, ii)]
            agree += i == j or left @ np.linalg.solve(spread, left) <= gate
        best = max(best, agree)
    assert one_point_consensus(innovations, s, gate).sum() == best


def test_nothing_plausible_means_nothing_accepted():
    innovations = np.full((4, 2), 100.0) * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]])
    accepted, whitening, _ = select_inliers(innovations, np.eye(8), pixel_gate(0.999))
    assert not accepted.any()
    assert whitening.shape == (0, 0)
