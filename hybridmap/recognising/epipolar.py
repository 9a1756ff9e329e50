"""The planar epipolar equation: minimal solutions, errors and refinement, many hypotheses at once.

Names as in bearings.py: rays (a, b) in view a, (a', b') in view b, hypotheses (theta, phi).
"""

from __future__ import annotations

import numpy as np

from hybridmap.pose import Array

_TINY = 1e-12


def two_point_solutions(a: Array, b: Array) -> Array:
    """All hypotheses from pairs of matches.

    The two equations in v = (cos phi, sin phi, cos psi, sin psi) have a plane of solutions; in it
    v_1^2 + v_2^2 = v_3^2 + v_4^2 is a quadratic. Where noise makes its discriminant negative, it counts as 0.

    Args:
        a: (H, 2, 2) slopes of two points in view a.
        b: (H, 2, 2) slopes of the same in view b.

    Returns:
        (4 H, 2) theta and phi, rad: two roots, each with either sign of the baseline.
    """
    rows = np.stack([-a[..., 0] * b[..., 1], b[..., 1], b[..., 0] * a[..., 1], a[..., 1]], axis=-1)
    _, _, basis = np.linalg.svd(rows)
    n1, n2 = basis[:, 2], basis[:, 3]
    metric = np.array([1.0, 1.0, -1.0, -1.0])
    p = (n1 * n1 * metric).sum(axis=1)
    q = (n1 * n2 * metric).sum(axis=1)
    r = (n2 * n2 * metric).sum(axis=1)
    root = np.sqrt(np.maximum(q * q - p * r, 0.0))
    found = []
    for sign in (1.0, -1.0):
        # p x^2 + 2 q x y + r y^2 = 0 in homogeneous (x, y), in the form that loses no digits.
        k = -(q + np.copysign(root, q))
        x, y = (k, p) if sign > 0 else (r, k)
        degenerate = np.hypot(x, y) < _TINY
        x, y = np.where(degenerate, 1.0, x), np.where(degenerate, 0.0, y)
        v = x[:, None] * n1 + y[:, None] * n2
        phi, psi = np.arctan2(v[:, 1], v[:, 0]), np.arctan2(v[:, 3], v[:, 2])
        # v and -v are the same solution; turning the baseline alone about turns psi about as well.
        found += [np.stack([phi + psi, phi], axis=1), np.stack([phi + psi, phi + np.pi], axis=1)]
    return np.concatenate(found)


def errors(a: Array, b: Array, hypotheses: Array, sigmas: Array) -> tuple[Array, Array]:
    """Sampson's error of each match under each hypothesis.

    Args:
        a: (N, 2) slopes in view a.
        b: (N, 2) slopes in view b.
        hypotheses: (H, 2) theta, phi.
        sigmas: (2,) standard deviation of a slope in a and in b.

    Returns:
        (H, N) squared errors in their variances, and (H, N) signed ones.
    """
    phi, psi = hypotheses[:, 1:], hypotheses[:, :1] - hypotheses[:, 1:]
    cos_phi, sin_phi, cos_psi, sin_psi = np.cos(phi), np.sin(phi), np.cos(psi), np.sin(psi)
    in_a = sin_phi - a[:, 0] * cos_phi
    in_b = sin_psi + b[:, 0] * cos_psi
    value = b[:, 1] * in_a + a[:, 1] * in_b
    variance = sigmas[0] ** 2 * ((b[:, 1] * cos_phi) ** 2 + in_b**2)
    variance = variance + sigmas[1] ** 2 * ((a[:, 1] * cos_psi) ** 2 + in_a**2)
    signed = value / np.sqrt(np.maximum(variance, _TINY * sigmas[0] ** 2))
    return signed**2, signed


def inverse_depths(a: Array, b: Array, hypotheses: Array, sigmas: Array | None = None) -> tuple[Array, Array]:
    """Baseline over depth in view a, by least squares on the ray in view b, and its standard deviation.

    Args:
        a: (N, 2) slopes in view a.
        b: (N, 2) slopes in view b.
        hypotheses: (H, 2) theta, phi.
        sigmas: (2,) standard deviation of a slope in a and in b; 1 without.

    Returns:
        (H, N) and (H, N).
    """
    theta, phi = hypotheses[:, :1], hypotheses[:, 1:]
    c, s = np.cos(theta), np.sin(theta)
    h1, h2 = c + s * a[:, 0], -s + c * a[:, 0]
    q1, q2 = np.cos(phi - theta), np.sin(phi - theta)
    w1, w2 = q2 - b[:, 0] * q1, -b[:, 1] * q1
    y1, y2 = h2 - b[:, 0] * h1, a[:, 1] - b[:, 1] * h1
    square = np.maximum(w1 * w1 + w2 * w2, _TINY)
    spread = np.ones(2) if sigmas is None else sigmas
    sigma = np.sqrt(spread[0] ** 2 + (spread[1] * h1) ** 2) / np.sqrt(square)
    return (w1 * y1 + w2 * y2) / square, sigma


def refined(a: Array, b: Array, start: Array, sigmas: Array, rounds: int) -> tuple[Array, Array]:
    """Least squares on Sampson's error from a start; damped, so that an unseen direction stays where it is.

    Returns:
        (2,) theta, phi, and their (2, 2) covariance.
    """
    found, step = start.copy(), 1e-6
    offsets = np.array([[0.0, 0.0], [step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    damping, normal = 1e-3, np.eye(2)
    for _ in range(rounds):
        _, signed = errors(a, b, found + offsets, sigmas)
        jacobian = np.stack([signed[1] - signed[2], signed[3] - signed[4]], axis=1) / (2.0 * step)
        normal, cost = jacobian.T @ jacobian, float((signed[0] ** 2).sum())
        change = np.linalg.solve(
            normal + damping * np.diag(np.diag(normal)) + 1e-3 * np.eye(2), -jacobian.T @ signed[0]
        )
        tried, _ = errors(a, b, (found + change)[None], sigmas)
        if float(tried.sum()) <= cost:
            found, damping = found + change, 0.1 * damping
            if np.abs(change).max() < 1e-9:
                break
        else:
            damping = 10.0 * damping
    # pi/sqrt(3) is the spread of a direction of which nothing is known.
    return found, np.asarray(np.linalg.inv(normal + np.diag([1e-6, 3.0 / np.pi**2])), np.float64)


def refined_turn(a: Array, b: Array, start: float, sigmas: Array) -> tuple[float, float]:
    """The turn alone that explains the matches best without any baseline, rad, and its variance, rad^2."""
    theta, step = start, 1e-6
    weight = 1.0
    for _ in range(6):
        here, ahead = (_turn_residuals(a, b, angle, sigmas) for angle in (theta, theta + step))
        slope = (ahead - here) / step
        weight = max(float((slope * slope).sum()), _TINY)
        theta -= float((slope * here).sum()) / weight
    return theta, 1.0 / weight


def turn_chi2(a: Array, b: Array, theta: float, sigmas: Array) -> float:
    """Squared misses of a turn without any baseline, in their variances: two degrees of freedom a match."""
    return float((_turn_residuals(a, b, theta, sigmas) ** 2).sum())


def _turn_residuals(a: Array, b: Array, theta: float, sigmas: Array) -> Array:
    """(N, 2) whitened misses in view b of the rays of view a, turned by theta."""
    c, s = np.cos(theta), np.sin(theta)
    depth = c + s * a[:, 0]
    depth = np.where(np.abs(depth) < 1e-3, 1e-3, depth)
    left, up = (c * a[:, 0] - s) / depth, a[:, 1] / depth
    # Of the miss (left, up): variances in view b plus those of view a, carried over; triangular root.
    va, vb = sigmas**2
    by_left = 1.0 / depth**2
    tilt = -a[:, 1] * s * by_left
    p = vb + va * by_left**2
    q = va * by_left * tilt
    r = vb + va * (tilt**2 + by_left)
    miss_left, miss_up = b[:, 0] - left, b[:, 1] - up
    first = miss_left / np.sqrt(p)
    second = (miss_up - q / p * miss_left) / np.sqrt(np.maximum(r - q * q / p, _TINY * vb))
    return np.stack([first, second], axis=1)
