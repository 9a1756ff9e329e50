"""Roll-outs against a fine independent integration of the unicycle under the law."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.agent.servo.laws import LAWS, control, lyapunov
from mapweave.agent.servo.polar import Polar, continued, polar_of
from mapweave.agent.servo.rollout import roll_out
from mapweave.hybridmap.pose import Pose2


@settings(max_examples=8, deadline=None)
@given(st.floats(0.2, 2.5), st.floats(0.3, 6.0), st.floats(-2.8, 2.8))
def test_roll_out_is_the_path_of_the_unicycle_under_each_law(rho: float, phi: float, beta: float):
    polar = Polar(rho, phi, beta)
    rollouts = roll_out(polar, 2.0, 0.006)
    dt = 0.008
    for law in range(LAWS):
        here = polar
        path = [here.pose().vector]
        for _ in range(1000):
            u, omega = control(here.phi, here.beta, 2.0)
            way, turn = here.rho * float(u) * dt, float(omega[law]) * dt
            moved = here.pose() @ Pose2(way * math.cos(turn / 2), way * math.sin(turn / 2), turn)
            here = continued(moved, here)
            path.append(moved.vector)
        fine = np.array(path)[:, :2]
        rolled = rollouts.poses[law][:, :2]
        gap = np.hypot(*(rolled[:, None] - fine[None]).transpose(2, 0, 1)).min(axis=1)
        assert gap.max() < 0.03 + 0.01 * rho


@given(st.floats(0.05, 2.5), st.floats(0.0, 6.2), st.floats(-3.1, 3.1))
def test_roll_outs_start_here_and_never_move_away(rho: float, phi: float, beta: float):
    polar = Polar(rho, phi, beta)
    rollouts = roll_out(polar, 2.0, 0.006)
    here = polar.pose().vector
    assert np.abs(rollouts.poses[:, 0, :2] - here[:2]).max() < 1e-9
    turned = rollouts.poses[:, 0, 2] - here[2]
    assert np.abs(np.angle(np.exp(1j * turned))).max() < 1e-9
    distance = np.hypot(rollouts.poses[..., 0], rollouts.poses[..., 1])
    assert (np.diff(distance, axis=1) <= 1e-9).all()
    assert (distance[rollouts.parked, -1] <= 0.006 + 1e-12).all()
    assert (rollouts.lengths >= rho - distance[:, -1] - 1e-9).all()


def test_a_law_parks_an_easy_start_and_lowers_its_own_function():
    rollouts = roll_out(polar_of(Pose2(-1.5, 0.4, -0.2)), 2.0, 0.006)
    assert rollouts.parked[0]
    assert rollouts.lengths[0] == pytest.approx(math.hypot(1.5, 0.4), rel=0.1)
    values = []
    polar = polar_of(Pose2(-1.5, 0.4, -0.2))
    for x, y, heading in rollouts.poses[0]:
        polar = continued(Pose2(x, y, heading), polar)
        values.append(lyapunov(polar.rho, polar.phi, polar.beta)[0])
    assert (np.diff(values) <= 1e-9).all()
