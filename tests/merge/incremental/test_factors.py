"""The large pose graph's numbers against matrices of the group and finite differences of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm, logm

from hybridmap.pose import Array
from merge.incremental.factors import CURVED, Factors

HUBER = 1.5
NODES = 5


def matrix(pose: Array) -> Array:
    """(3, 3) of a posture [x m, y m, heading rad]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def exponential(twist: Array) -> Array:
    """(3, 3) where a twist leads in unit time."""
    generator: Array = expm(np.array([[0.0, -twist[2], twist[0]], [twist[2], 0.0, twist[1]], [0.0] * 3]))
    return generator


def logarithm(motion: Array) -> Array:
    """(3,) the twist of a motion."""
    generator = np.real(logm(motion))
    return np.array([generator[0, 2], generator[1, 2], generator[1, 0]])


class Graph:
    """A few nodes with measurements between them, some far off; every number by matrices."""

    def __init__(self, seed: int, robust: bool = True, noise: float = 0.3) -> None:
        rng = np.random.default_rng(seed)
        self.means = rng.normal(0.0, 1.0, (NODES, 3))
        ends = [(a, b) for a in range(NODES) for b in range(a + 1, NODES)] + [(0, 1), (3, 2)]
        roots = rng.normal(0.0, 1.0, (len(ends), 3, 3))
        off = rng.normal(0.0, noise, (len(ends), 3))
        off[::3] *= 4.0
        between = [
            np.linalg.inv(matrix(self.means[a])) @ matrix(self.means[b]) @ exponential(o)
            for (a, b), o in zip(ends, off, strict=True)
        ]
        measured = np.array([[m[0, 2], m[1, 2], math.atan2(m[1, 0], m[0, 0])] for m in between])
        weights = roots @ roots.transpose(0, 2, 1) + np.eye(3)
        kinds = np.full(len(ends), robust)
        kinds[1::4] = False
        a, b = np.array(ends).T
        self.factors = Factors(a, b, measured, weights, kinds)

    def residuals(self, moves: Array) -> Array:
        """(M, 3) after the nodes were moved by (3N,), each on its right."""
        f = self.factors
        here = [matrix(p) @ exponential(d) for p, d in zip(self.means, moves.reshape(-1, 3), strict=True)]
        return np.array(
            [
                logarithm(np.linalg.inv(matrix(m)) @ np.linalg.inv(here[a]) @ here[b])
                for a, b, m in zip(f.a, f.b, f.means, strict=True)
            ]
        )

    def loss(self, residuals: Array) -> float:
        """Huber's, of robust measurements; half the square of the others."""
        total = 0.0
        for r, weight, robust in zip(residuals, self.factors.weights, self.factors.robust, strict=True):
            size = math.sqrt(float(r @ weight @ r))
            total += HUBER * (size - 0.5 * HUBER) if robust and size > HUBER else 0.5 * size**2
        return total

    def limited(self) -> int:
        """How many pull no harder."""
        return int((self.factors.robust & (self.factors.strains(self.means) > HUBER**2)).sum())


def slopes(function: object, at: Array, step: float) -> Array:
    """Central differences along each coordinate, (len(at), ...)."""
    return np.array(
        [
            (function(at + step * unit) - function(at - step * unit)) / (2.0 * step)  # type: ignore[operator]
            for unit in np.eye(len(at))
        ]
    )


@pytest.mark.parametrize("seed", range(3))
def test_residuals_cost_and_pull_are_those_of_the_group(seed: int) -> None:
    graph, still = Graph(seed), np.zeros(3 * NODES)
    assert 0 < graph.limited() < len(graph.factors)
    assert np.allclose(graph.factors.residuals(graph.means), graph.residuals(still), atol=1e-9)
    assert graph.factors.cost(graph.means, HUBER) == pytest.approx(graph.loss(graph.residuals(still)))
    gradient = slopes(lambda moves: graph.loss(graph.residuals(moves)), still, 1e-6)
    for curved in (False, True):
        pull = graph.factors.system(graph.means, HUBER, curved)[1]
        assert np.allclose(pull, -gradient, atol=1e-5 * np.abs(gradient).max())


@pytest.mark.parametrize("seed", range(3))
def test_newton_s_curvature_is_the_second_derivative_of_the_loss(seed: int) -> None:
    """Of what the residuals are to first order: how they bend themselves neither step heeds."""
    graph, still = Graph(seed), np.zeros(3 * NODES)
    assert graph.limited() > 1
    first, bent = graph.residuals(still), slopes(graph.residuals, still, 1e-6)

    def straight(moves: Array) -> float:
        return graph.loss(first + np.tensordot(moves, bent, 1))

    curvature = slopes(lambda moves: slopes(straight, moves, 1e-4), still, 1e-4)
    plain, newton = (
        graph.factors.system(graph.means, HUBER, curved)[0].toarray() for curved in (False, True)
    )
    size = np.abs(curvature).max()
    # Heeded but for a hundredth, which the step without it stands for.
    assert np.allclose(newton, CURVED * curvature + (1.0 - CURVED) * plain, atol=1e-5 * size)
    assert np.abs(newton - plain).max() > 0.05 * size
    assert np.abs(newton - newton.T).max() < 1e-9 * size
    # It still says something of every direction in which nodes could move against each other.
    held = np.linalg.eigvalsh(newton[3:, 3:])
    assert held.min() > 1e-4 * held.max()


@pytest.mark.parametrize("graph", [Graph(5, robust=False), Graph(5, noise=0.02)], ids=["sure", "near"])
def test_where_nothing_is_limited_there_is_no_more_curvature(graph: Graph) -> None:
    assert graph.limited() == 0
    plain, newton = (
        graph.factors.system(graph.means, HUBER, curved)[0].toarray() for curved in (False, True)
    )
    assert np.array_equal(plain, newton)
