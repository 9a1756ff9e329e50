"""What the filter's helpers remember from step to step."""

import numpy as np
import pytest

from mapweave import Odometry, Pose2
from mapweave.agent.ekf.adaptive_odometry_noise import DISTRUST, AdaptiveOdometryNoise
from mapweave.agent.ekf.filter_health import FilterHealth
from mapweave.agent.ekf.motion import WheelNoise
from mapweave.agent.ekf.update_report import Health


def asked(converged: bool, watch: FilterHealth) -> Health:
    return watch.health(lambda: converged)[0]


def test_parallax_is_counted_from_where_landmarks_were_taken_up():
    watch = FilterHealth(focal=250.0)
    for x in (0.02, 0.04, 0.049):
        watch.moved(np.array([x, 0.0, 0.1]))
        watch.saw(Health.GOOD, "")
    assert asked(False, watch) is Health.NO_PARALLAX
    assert asked(True, watch) is Health.GOOD
    # 5 px of 250 at 2.5 m; going back takes nothing away.
    for x in (0.051, 0.0):
        watch.moved(np.array([x, 0.0, 0.1]))
        watch.saw(Health.GOOD, "")
    assert asked(False, watch) is Health.GOOD
    watch.took_up(np.array([0.0, 0.0, 0.1]))
    assert asked(False, watch) is Health.NO_PARALLAX


def test_the_base_stays_where_it_is_under_a_new_anchor():
    watch = FilterHealth(focal=250.0)
    watch.took_up(np.array([0.3, 0.2, 0.0]))
    new = Pose2(0.34, 0.2, 2.0)
    watch.reanchored(new)
    watch.moved(np.zeros(3))
    watch.saw(Health.GOOD, "")
    assert asked(False, watch) is Health.NO_PARALLAX
    assert "40 mm" in watch.health(lambda: False)[1]


def test_missing_images_are_reported_first():
    watch = FilterHealth(focal=250.0)
    watch.saw(Health.FEW, "2 are left")
    watch.moved(np.zeros(3))
    assert watch.health(lambda: True) == (Health.FEW, "2 are left")
    watch.moved(np.zeros(3))
    assert watch.health(lambda: True) == (Health.NO_IMAGE, "no image for 2 steps")


def test_refuted_wheels_get_more_noise_for_a_while():
    noise = WheelNoise(0.24, 0.02)
    trust = AdaptiveOdometryNoise(noise, 0.0)
    step, stands = Odometry(0.1, 0.0), Odometry(0.0, 0.0)
    np.testing.assert_array_equal(trust.root(step), noise.root(step))
    np.testing.assert_array_equal(trust.refuted(step, 7.0), noise.refuted_root(step, 7.0, 0.1))
    for _ in range(DISTRUST):
        assert trust.increased
        # Wheels that claim to stand may have gone anywhere.
        assert trust.root(stands)[0, 0] == pytest.approx(0.05)
    assert not trust.increased
    np.testing.assert_array_equal(trust.root(stands), noise.root(stands))
