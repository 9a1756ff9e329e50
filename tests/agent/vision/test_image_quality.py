"""Image quality against scikit-image, and on images that something is wrong with."""

import cv2
import numpy as np
import pytest

from mapweave.agent.vision.image_quality import MOST_BLUR, ImageQuality, blur_effect
from mapweave.hybridmap.pose import Pose2

measure = pytest.importorskip("skimage.measure")


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.0, 4.0])
def test_the_blur_effect_is_that_of_scikit_image(walls, sigma: float):
    """It differentiates by Sobel's operator, where the paper takes differences, and cuts the border off."""
    image = walls.render(Pose2()).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image
    assert blur_effect(image) == pytest.approx(measure.blur_effect(image, h_size=9), abs=0.08)


def test_a_good_image_has_no_fault_whatever_its_size(walls):
    image = walls.render(Pose2())
    for factor in (0.5, 1.0, 3.0):
        scaled = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        quality = ImageQuality.of(scaled)
        assert quality.fault == "" and quality.blur < MOST_BLUR


@pytest.mark.parametrize(
    ("level", "words"), [(0, "dark"), (8, "dark"), (255, "overexposed"), (120, "almost nothing to track")]
)
def test_an_image_of_nothing_is_named(level: int, words: str):
    noise = np.random.default_rng(0).normal(0.0, 1.5, (240, 320))
    image = np.clip(level + noise, 0, 255).astype(np.uint8)
    assert words in ImageQuality.of(image).fault
