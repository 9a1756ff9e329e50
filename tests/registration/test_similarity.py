"""Similarity transforms: against scipy, refits by brute force, and Monte Carlo."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.registration.similarity import (
    Similarity,
    check_pairs,
    fit_similarity,
    leave_one_out,
    scale_contradiction,
    wrong_pair,
)
from tests.quick import first_quick

SIGMA = 0.1
TRUTH = Similarity(3.0, -7.0, 2.1, 0.05)
numbers = st.floats(-50.0, 50.0)
transforms = st.builds(Similarity, numbers, numbers, st.floats(-3.1, 3.1), st.floats(0.01, 20.0))


def world(
    seed: int, count: int, truth: Similarity = TRUTH, correlated: bool = True
) -> tuple[Array, Array, Array]:
    """Noisy points in a, exact points in b (pixels), and the joint covariance in a."""
    rng = np.random.default_rng(seed)
    b = rng.uniform(0.0, 800.0, (count, 2))
    root = rng.normal(0.0, SIGMA, (2 * count, 2 * count)) / math.sqrt(2 * count) if correlated else 0.0
    covariance = (
        SIGMA**2 * np.eye(2 * count) + root @ np.transpose(root)
        if correlated
        else SIGMA**2 * np.eye(2 * count)
    )
    noise = rng.multivariate_normal(np.zeros(2 * count), covariance).reshape(-1, 2)
    return truth.apply(b) + noise, b, covariance


def by_scipy(a: Array, b: Array, covariance: Array, scale: float | None) -> tuple[Similarity, float]:
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T

    def similarity(p: Array) -> Similarity:
        return Similarity(p[0], p[1], p[2], scale or math.exp(p[3]))

    starts = np.linspace(-math.pi, math.pi, 9)[:-1]
    solutions = [
        least_squares(
            lambda p: root @ (a - similarity(p).apply(b)).ravel(),
            [0.0, 0.0, heading, math.log(scale or TRUTH.scale)][: 3 if scale else 4],
            xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac",
        )
        for heading in starts
    ]  # fmt: skip
    best = min(solutions, key=lambda solution: solution.cost)
    return similarity(best.x), 2.0 * best.cost


@given(transforms, st.integers(0, 2**32 - 1), st.integers(3, 9), st.booleans())
@settings(max_examples=40, deadline=None)
def test_exact_pairs_give_the_exact_transform(truth: Similarity, seed: int, count: int, known: bool):
    b = np.random.default_rng(seed).uniform(0.0, 100.0, (count, 2))
    fit = fit_similarity(truth.apply(b), b, np.eye(2 * count), truth.scale if known else None)
    assert np.allclose(fit.a_from_b.apply(b), truth.apply(b), atol=1e-6)
    assert math.isclose(fit.a_from_b.scale, truth.scale, rel_tol=1e-7)


@pytest.mark.parametrize("known", [None, TRUTH.scale])
def test_the_optimum_is_that_of_scipy(known: float | None):
    for seed in range(4):
        a, b, covariance = world(seed, 3 + seed)
        fit = fit_similarity(a, b, covariance, known)
        best, chi2 = by_scipy(a, b, covariance, known)
        assert np.allclose(fit.a_from_b.apply(b), best.apply(b), atol=2e-5)
        assert fit.chi2 == pytest.approx(chi2, rel=1e-6)
        assert fit.freedom == 2 * len(a) - (3 if known else 4)


@pytest.mark.parametrize("known", first_quick([None, TRUTH.scale], 1))
def test_the_covariance_is_that_of_many_trials(known: float | None):
    count, trials = 5, 1500
    _, b, covariance = world(1, count)
    noise = np.random.default_rng(7).multivariate_normal(np.zeros(2 * count), covariance, trials)
    found, predicted = [], None
    for one in noise:
        fit = fit_similarity(TRUTH.apply(b) + one.reshape(-1, 2), b, covariance, known)
        t = fit.a_from_b
        found.append([t.x, t.y, t.heading, math.log(t.scale)])
        predicted = fit.covariance / fit.excess
    assert predicted is not None
    used = 3 if known else 4
    sample, expected = np.cov(np.array(found).T)[:used, :used], predicted[:used, :used]
    # Wishart: an entry of a whitened sample covariance has a standard deviation of sqrt(2 / trials) at most.
    root = np.linalg.inv(np.linalg.cholesky(expected))
    assert np.abs(root @ sample @ root.T - np.eye(used)).max() < 5.0 * math.sqrt(2.0 / trials)
    assert known is None or not predicted[3].any()


def test_it_does_not_matter_which_point_is_held():
    """A motion of all points as one, however uncertain, changes the covariance and not the transform."""
    a, b, covariance = world(3, 6)
    moves = np.zeros((6, 2, 3))
    moves[:, 0, 0] = moves[:, 1, 1] = 1.0
    for known in (None, TRUTH.scale):
        fit = fit_similarity(a, b, covariance, known)
        at = fit.a_from_b.apply(b)
        moves[:, :, 2] = np.stack([-at[:, 1], at[:, 0]], axis=1)
        flat = moves.reshape(-1, 3)
        held_elsewhere = covariance + flat @ np.diag([4.0, 1.0, 0.01]) @ flat.T
        other = fit_similarity(a, b, held_elsewhere, known)
        assert np.allclose(other.a_from_b.apply(b), at, atol=2e-3)
        assert other.sigmas[0] > fit.sigmas[0]


@pytest.mark.parametrize("known", first_quick([None, TRUTH.scale], 1))
def test_each_wrong_pair_is_named(known: float | None):
    named = 0
    for seed in range(20):
        count = 5 + seed % 4
        a, b, covariance = world(100 + seed, count)
        wrong = seed % count
        a[wrong] += Pose2(0.0, 0.0, seed * 1.0).apply(np.array([3.0, 0.0]))
        out = leave_one_out(a, b, covariance, known)
        named += wrong_pair(out) == wrong
        rest = np.delete(np.arange(count), wrong)
        rows = (2 * rest[:, None] + np.arange(2)).ravel()
        others, _ = by_scipy(a[rest], b[rest], covariance[np.ix_(rows, rows)], known)
        assert out[wrong].off == pytest.approx(
            float(np.linalg.norm(a[wrong] - others.apply(b[wrong]))), abs=1e-4
        )
    assert named >= 19


@pytest.mark.parametrize("known", [None, TRUTH.scale])
@pytest.mark.parametrize("sloppy", first_quick([1.0, 4.0], 1))
def test_right_pairs_are_rarely_called_wrong(known: float | None, sloppy: float):
    """Also where a person clicks four times less exactly than assumed."""
    trials = 200
    false = 0
    for seed in range(trials):
        a, b, covariance = world(1000 + seed, 6, correlated=False)
        exact = TRUTH.apply(b)
        false += wrong_pair(leave_one_out(exact + sloppy * (a - exact), b, covariance, known)) is not None
    # One in a hundred is the level of the test; five in two hundred has a chance of 5 %.
    assert false <= 7


def test_three_pairs_with_a_free_scale_cannot_name_the_wrong_one():
    a, b, covariance = world(5, 3)
    a[1] += 5.0
    assert wrong_pair(leave_one_out(a, b, covariance)) is None
    assert wrong_pair(leave_one_out(a, b, covariance, TRUTH.scale)) in (None, 1)


def test_a_stretched_plan_contradicts_its_scale():
    a, b, covariance = world(11, 8, Similarity(1.0, 2.0, -0.4, 0.0512), correlated=False)
    scale, sigmas = scale_contradiction(a, b, covariance, 0.05)
    assert scale == pytest.approx(0.0512, rel=0.01)
    assert sigmas > 3.0
    off = [scale_contradiction(*world(20 + seed, 8), TRUTH.scale)[1] for seed in range(60)]
    assert sum(one > 3.0 for one in off) <= 1
    assert sum(one > 1.0 for one in off) >= 8


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize("given", [0.02, 0.1])
def test_pairs_that_agree_on_another_scale_than_the_given_one_are_not_called_wrong(count: int, given: float):
    a, b, covariance = world(11, count, correlated=False)
    words = f"the given scale of {given:g} m/px does not fit: .* agree on 0.0(49|50)"
    with pytest.raises(InvalidValue, match=words):
        check_pairs(a, b, covariance, given)
    a[1] += 20.0, -10.0
    with pytest.raises(InvalidValue, match="contradict each other"):
        check_pairs(a, b, covariance, given)


@pytest.mark.parametrize("count", [3, 4, 5, 8])
@pytest.mark.parametrize("factor", [1.1, 1.5, 2.0])
def test_a_wrong_scale_is_named_however_many_pairs_there_are(count: int, factor: float):
    """Of more pairs the mirror image is clearly worse, also with a wrong scale."""
    for seed in range(5):
        a, b, covariance = world(seed, count)
        with pytest.raises(InvalidValue, match=r"the given scale of .* agree on 0\.0(49|50?)"):
            check_pairs(a, b, covariance, factor * TRUTH.scale)


@pytest.mark.parametrize("off", [1.0, 2.0, 5.0])
def test_a_wrong_pair_of_many_is_not_taken_for_a_wrong_scale(off: float):
    rng = np.random.default_rng(3)
    for seed in range(30):
        a, b, covariance = world(seed, 8)
        a[1] += Similarity(0.0, 0.0, rng.uniform(-3.1, 3.1)).apply(np.array([off, 0.0]))
        check_pairs(a, b, covariance, TRUTH.scale)


def test_pairs_that_determine_nothing_are_refused():
    plane = np.array([[0.0, 0.0], [400.0, 0.0], [100.0, 300.0], [350.0, 500.0]])
    loose = 0.01 * np.eye(8)
    check_pairs(TRUTH.apply(plane), plane, loose)
    check_pairs(TRUTH.apply(plane), plane, loose, TRUTH.scale)
    with pytest.raises(InvalidValue, match="2 pairs are too few"):
        check_pairs(plane[:2], plane[:2], np.eye(4))
    with pytest.raises(InvalidValue, match="in one place"):
        check_pairs(np.ones((3, 2)), np.ones((3, 2)), np.eye(6))
    with pytest.raises(InvalidValue, match="too near to each other: they lie within 0\\.0"):
        check_pairs(TRUTH.apply(plane / 400.0), plane / 400.0, loose)
    line = plane * (1.0, 0.001)
    with pytest.raises(InvalidValue, match="in a line"):
        check_pairs(TRUTH.apply(line), line, loose)
    with pytest.raises(InvalidValue, match="mirror image of the plan fits better"):
        check_pairs(TRUTH.apply(plane * (1.0, -1.0)), plane, loose)
    exchanged = plane[[1, 0, 2]]
    with pytest.raises(InvalidValue, match=r"two pairs are exchanged|contradict"):
        check_pairs(TRUTH.apply(exchanged), plane[:3], loose[:6, :6])
