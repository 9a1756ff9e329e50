"""Compact descriptors: the code is what it says, and real features survive it."""

import cv2
import numpy as np
import pytest
import skimage.data

from hybridmap.descriptor import DIMENSIONS, LEVELS, decode, encode, root_sift, table
from hybridmap.errors import InvalidFile, InvalidValue
from hybridmap.matching import match, match_vectors


def fake_sift(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).gamma(0.6, 30.0, (n, 128)).astype(np.float32)


def test_decoded_is_the_nearest_level_of_each_coordinate() -> None:
    sift = fake_sift(50, 1)
    projected, levels = table().project(sift), table().levels
    nearest = np.abs(projected[:, :, None] - levels[None]).argmin(axis=2)
    expected = np.take_along_axis(np.broadcast_to(levels, (50, DIMENSIONS, LEVELS)), nearest[..., None], 2)[
        ..., 0
    ]
    assert np.array_equal(decode(encode(sift)), expected)


def test_even_coordinates_lie_in_the_low_half_of_the_byte() -> None:
    codes = np.zeros((1, 16), np.uint8)
    codes[0, 3] = 0x5A
    assert decode(codes)[0, 6] == table().levels[6, 0xA]
    assert decode(codes)[0, 7] == table().levels[7, 0x5]


def test_projection_is_what_the_table_says() -> None:
    sift = fake_sift(8, 2)
    roots = np.sqrt(sift / sift.sum(axis=1, keepdims=True))
    assert np.allclose(table().project(sift), (roots - table().mean) @ table().basis, atol=1e-6)
    assert np.allclose(table().basis.T @ table().basis, np.eye(DIMENSIONS), atol=2e-3)


def test_scale_of_the_input_does_not_matter_and_nothing_is_no_harm() -> None:
    sift = fake_sift(5, 3)
    assert np.array_equal(encode(sift), encode(sift / 512))
    assert encode(np.zeros((2, 128))).shape == (2, 16)
    assert encode(np.zeros((0, 128))).shape == (0, 16)
    assert decode(np.zeros((0, 16), np.uint8)).shape == (0, 32)


@pytest.mark.parametrize("wrong", [np.zeros((3, 127)), np.full((1, 128), np.nan), np.zeros(128)])
def test_what_is_no_sift_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(InvalidValue):
        encode(wrong)


def test_what_is_no_code_is_refused() -> None:
    with pytest.raises(InvalidValue):
        decode(np.zeros((3, 16), np.int64))  # type: ignore[arg-type]
    with pytest.raises(InvalidValue):
        decode(np.zeros((3, 15), np.uint8))


def test_a_table_with_levels_out_of_order_is_refused() -> None:
    good = table()
    with pytest.raises(InvalidFile):
        type(good)(good.mean, good.basis, good.levels[:, ::-1])


def test_codes_keep_nine_of_ten_right_matches_of_real_photographs() -> None:
    """Two cameras side by side, with the true disparity of each pixel."""
    left, right, disparity = skimage.data.stereo_motorcycle()
    detector = cv2.SIFT_create(nfeatures=500)
    pixels, sift = [], []
    for image in (left, right):
        keypoints, found = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        pixels.append(np.array([k.pt for k in keypoints]))
        sift.append(found)

    def right_ones(pairs: np.ndarray) -> int:
        a, b = pixels[0][pairs[:, 0]], pixels[1][pairs[:, 1]]
        shift = disparity[a[:, 1].round().astype(int), a[:, 0].round().astype(int)]
        known = np.isfinite(shift)
        a, b, shift = a[known], b[known], shift[known]
        return int((np.abs(a - [1, 0] * shift[:, None] - b).max(axis=1) < 2.5).sum())

    full = right_ones(match_vectors(root_sift(sift[0]), root_sift(sift[1])).pairs)
    code = right_ones(match(encode(sift[0]), encode(sift[1])))
    assert full > 80
    assert code >= 0.9 * full
