"""The localization benchmark draws what it says, and judges by it."""

import numpy as np
import pytest
from scipy.special import chdtri

from synthetic.localization_run import FEW, SurveyedNode, draw_place, drive, try_drives, try_start


def test_a_place_has_a_pose_error():
    true = np.zeros((2, 3))
    place = SurveyedNode(
        true, np.array([[0.3, 0.4, 0.0], [0.0, 0.0, 0.0]]), np.array([np.eye(3), np.eye(3)]) * 0.25
    )
    assert place.error == pytest.approx(0.5 / np.sqrt(2))
    assert place.nees == pytest.approx(0.5)


def test_map_errors_match_their_covariances():
    """The average NEES lies in its interval, widened for the bend of depth over inverse depth."""
    places = [draw_place(np.random.default_rng([31, k])) for k in range(100)]
    landmarks = sum(len(place.true) for place in places)
    mean = sum(place.nees * len(place.true) for place in places) / landmarks
    low, high = chdtri(3 * landmarks, [0.999, 0.001]) / landmarks
    assert 0.95 * low < mean < 1.05 * high
    assert min(len(place.true) for place in places) <= FEW


def test_starts_with_few_landmarks_in_view_are_among_them():
    """At least four, as the static fix needs them; and not all of many."""
    visible = [try_start(np.random.default_rng([32, k]), steps=1).visible for k in range(60)]
    assert min(visible) >= 4
    assert 3 <= sum(count <= FEW for count in visible) <= 40


def test_a_start_is_judged_from_its_nineteenth_step_on():
    """A map that is wrong by a metre everywhere leaves the pose wrong, whenever it is judged."""
    place = draw_place(np.random.default_rng(33))
    wrong = np.random.default_rng(1).normal(size=place.true.shape)
    nowhere = SurveyedNode(place.true, place.true + wrong, 1e4 * place.covariances)
    early, late = (drive(np.random.default_rng(34), nowhere, steps) for steps in (18, 19))
    assert early.converged
    assert not early.near
    assert not late.converged


@pytest.mark.slow
def test_driving_again_makes_the_map_better():
    kept = [try_drives(np.random.default_rng([35, k]), 3, steps=60) for k in range(5)]
    errors = np.median([[place.error for place in places] for places in kept], axis=0)
    assert errors[1] < 0.7 * errors[0]
    assert errors[3] < 0.8 * errors[1]
