"""The paper's equations against finite differences of the true unicycle and against their literal form."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mapweave.agent.servo.laws import LAWS, charts, control, law_paths, lyapunov, saturate
from mapweave.agent.servo.polar import Polar, continued, polar_of
from mapweave.hybridmap.pose import Pose2, wrap_angle

rho_ = st.floats(0.05, 4.0)
phi_ = st.floats(0.01, 2 * math.pi - 0.01)
beta_ = st.floats(-math.pi + 0.01, math.pi - 0.01)
law_ = st.integers(0, LAWS - 1)


@given(rho_, phi_, beta_)
def test_polar_coordinates_round_trip(rho: float, phi: float, beta: float):
    polar = polar_of(Polar(rho, phi, beta).pose())
    assert polar.rho == pytest.approx(rho)
    assert polar.phi == pytest.approx(phi)
    assert wrap_angle(polar.beta - beta) == pytest.approx(0.0, abs=1e-9)


def unicycle_step(polar: Polar, forward: float, turn: float, dt: float) -> Polar:
    pose = polar.pose()
    moved = pose @ Pose2(
        forward * dt * math.cos(turn * dt / 2), forward * dt * math.sin(turn * dt / 2), turn * dt
    )
    return continued(moved, polar)


@given(rho_, phi_, beta_, law_, st.floats(0.3, 4.0))
def test_lyapunov_rate_is_the_derivative_along_the_true_unicycle(
    rho: float, phi: float, beta: float, law: int, lambda_: float
):
    u, omega = control(phi, beta, lambda_)
    forward, turn = rho * float(u), float(omega[law])
    dt = 1e-5
    ahead = unicycle_step(Polar(rho, phi, beta), forward, turn, dt)
    astern = unicycle_step(Polar(rho, phi, beta), -forward, -turn, dt)
    after = lyapunov(ahead.rho, ahead.phi, ahead.beta)[law]
    before = lyapunov(astern.rho, astern.phi, astern.beta)[law]
    rate = -((rho * math.cos(beta)) ** 2) - lambda_ * charts(phi, beta)[1][law] ** 2
    assert (after - before) / (2 * dt) == pytest.approx(rate, rel=1e-4, abs=1e-4)
    assert rate <= 0.0


@given(phi_, beta_, law_, st.floats(0.3, 4.0))
def test_control_is_equation_5(phi: float, beta: float, law: int, lambda_: float):
    phi_tilde, beta_tilde = (float(c[law]) for c in charts(phi, beta))
    assume(abs(beta_tilde) > 1e-3)
    u, omega = control(phi, beta, lambda_)
    literal = lambda_ * beta_tilde + math.sin(beta) * math.cos(beta) / beta_tilde * (phi_tilde + beta_tilde)
    assert u == pytest.approx(math.cos(beta))
    assert omega[law] == pytest.approx(literal, rel=1e-6, abs=1e-9)


def test_control_has_no_hole_where_beta_tilde_vanishes():
    for beta in (0.0, math.pi, -math.pi):
        _, at = control(1.0, beta, 2.0)
        _, beside = control(1.0, beta + 1e-7, 2.0)
        assert np.isfinite(at).all()
        assert at == pytest.approx(beside, abs=1e-5)


def test_all_equilibria_are_the_goal_pose():
    laws = np.arange(LAWS)
    zero = np.zeros((1, LAWS))
    poses = law_paths(laws, zero, zero, zero)[:, 0]
    assert np.abs(poses[:, :2]).max() == 0.0
    assert [wrap_angle(float(h)) for h in poses[:, 2]] == pytest.approx([0.0] * LAWS, abs=1e-9)


def test_the_sign_of_each_law():
    # At the equilibrium of chart i, beta = -BETA_SHIFT[i]: forward for chart 1, backward for the others.
    _, beta_tilde = charts(0.0, 0.0)
    assert pytest.approx(np.cos(-beta_tilde)) == [1.0, -1.0, -1.0, -1.0, -1.0]


@given(st.floats(-3, 3), st.floats(-5, 5))
def test_saturation_keeps_the_curvature_and_the_limits(forward: float, turn: float):
    v, w = saturate(forward, turn, 0.3, 0.8)
    assert abs(v) <= 0.3 + 1e-12
    assert abs(w) <= 0.8 + 1e-12
    assert v * turn == pytest.approx(w * forward, abs=1e-9)
    if abs(forward) <= 0.3 and abs(turn) <= 0.8:
        assert (v, w) == (forward, turn)
