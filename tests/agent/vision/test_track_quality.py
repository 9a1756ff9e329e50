"""The report of the tracks against counts by hand."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.vision.track_quality import TrackQuality, coverage
from mapweave.hybridmap.camera import Camera

CAMERA = Camera(320, 240, 277.0, 276.0, 158.0, 121.0, mount_height=0.3)


@given(st.lists(st.tuples(st.floats(-50, 400), st.floats(-50, 300)), max_size=40))
def test_coverage_counts_cells(pixels):
    cells = {(int(x // 80), int(y // 60)) for x, y in pixels if 0 <= x <= 319 and 0 <= y <= 239}
    assert coverage(CAMERA, np.array(pixels).reshape(-1, 2)) == len(cells) / 16


def test_figures_are_those_of_the_tracks():
    pixels = np.array([[10.0, 10.0], [15.0, 12.0], [310.0, 230.0]])
    misses = np.array([[3.0, 4.0], [0.0, 1.0], [0.0, -2.0]])
    report = TrackQuality.of(CAMERA, pixels, np.array([1, 5, 40]), misses)
    assert (report.alive, report.age_median) == (3, 5.0)
    assert report.coverage == 2 / 16
    assert report.error_px_median == 2.0
    assert str(report) == (
        "3 tracks over 12 % of the image, 5 images old in the median, 2.00 px from where they should be"
    )


def test_without_tracks_nothing_is_claimed():
    none = np.zeros((0, 2))
    report = TrackQuality.of(CAMERA, none, np.zeros(0, np.int64), none)
    assert (report.alive, report.age_median, report.coverage) == (0, 0.0, 0.0)
    assert math.isnan(report.error_px_median)
    assert str(report) == "0 tracks over 0 % of the image"
