"""The landmark benchmark judges matches by truth, counts what it says, and refuses what it cannot use."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.images.known_warps import load, warp
from benchmarks.landmarks import benchmark as landmarks
from benchmarks.landmarks.benchmark import KeptMatches, figures, node_figures
from benchmarks.landmarks.pairs import _room_pair, _warped_pair, camera_of, epipolar, folder_pairs
from benchmarks.landmarks.rivals import Packed, features
from mapweave.hybridmap.errors import InvalidFile


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["landmarks", *arguments])
    landmarks.main()


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Three views of the same coins."""
    rng, image = np.random.default_rng(3), load("coins")
    for name, view in zip(("9", "10", "11"), (image, *(warp(image, rng)[0] for _ in range(2))), strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), view)
    return tmp_path


def test_a_folder_of_photographs(photographs: Path, monkeypatch, capsys):
    (photographs / "notes.txt").write_text("no photograph")
    (photographs / "broken.jpg").write_text("no photograph either")
    run(monkeypatch, "--images", str(photographs), "--places", "0", "--json")
    out, err = capsys.readouterr()
    result = json.loads(out.splitlines()[-1])
    assert "broken.jpg is no image" in err
    assert "notes.txt" not in err
    assert result["pairs"] == 3
    assert 0.9 < result["inliers_ratio_to_float_sift"] < 1.1
    assert 2500 < result["bytes_per_node"] <= 3000
    assert result["ways"]["ours"]["bytes"] < result["ways"]["orb"]["bytes"]
    assert result["ways"]["float sift"]["inliers_ratio"] == 1
    assert {"bytes_per_landmark", "pairs_matched_ratio", "encode_ms", "decode_ms"} <= set(result)


def test_neighbours_come_first_when_there_are_too_many(photographs: Path):
    """By number: 10 comes after 9."""
    first, second, _ = (
        cv2.imread(str(photographs / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for name in (9, 10, 11)
    )
    pairs = folder_pairs(photographs, seed=0, most=2)
    assert len(pairs) == 2
    assert np.array_equal(pairs[0].first, first)
    assert np.array_equal(pairs[0].second, second)
    assert np.array_equal(pairs[1].first, second)


@pytest.mark.parametrize("content", ["missing", "empty", "one", "different"])
def test_a_missing_folder_is_reported_in_one_line(content: str, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "views"
    if content != "missing":
        folder.mkdir()
    if content in ("one", "different"):
        cv2.imwrite(str(folder / "a.png"), load("coins"))
    if content == "different":
        cv2.imwrite(str(folder / "b.png"), np.full((240, 320), 128, np.uint8))
    with pytest.raises(SystemExit) as error:
        run(monkeypatch, "--images", str(folder), "--places", "0")
    assert error.value.code == 1
    output = capsys.readouterr().err.strip().splitlines()
    assert output[-1].startswith("landmarks: ")
    assert str(folder) in output[-1]


def test_matches_of_a_warp_agree_with_the_homography():
    """To 3 px of where the homography takes a feature, written down here once more."""
    rng = np.random.default_rng(1)
    pair = _warped_pair(load("coins"), rng)
    pixels, _ = features(pair.first, camera_of(pair.first))
    other, _ = features(pair.second, camera_of(pair.second))
    count = min(len(pixels), len(other))
    assert pair.right(pixels[:count], rng.permutation(other)[:count]) <= 0.1 * count
    _, b_from_a = warp(load("coins"), np.random.default_rng(1))
    at = np.column_stack([pixels, np.ones(len(pixels))]) @ b_from_a.T
    at = at[:, :2] / at[:, 2:]
    assert pair.right(pixels, at + np.array([2.0, 0.0])) == len(pixels)
    assert pair.right(pixels, at + np.array([4.0, 0.0])) == 0
    assert pair.right(pixels[:0], at[:0]) == 0


def test_matches_of_rooms_are_right_where_both_rays_meet_the_same_point():
    """Features matched by chance are wrong."""
    pair = _room_pair(np.random.default_rng(5))
    pixels, _ = features(pair.first, pair.camera)
    other, _ = features(pair.second, pair.camera)
    count = min(len(pixels), len(other))
    assert count > 20
    chance = pair.right(pixels[:count], np.random.default_rng(1).permutation(other)[:count])
    assert chance <= 0.1 * count
    assert pair.depths is not None
    assert np.nanmin(pair.depths(pixels)) > 0.05


def test_epipolar_geometry_of_points_that_were_really_seen_twice():
    rng = np.random.default_rng(2)
    points = rng.uniform([-2, -1, 3], [2, 1, 8], (60, 3))
    first = 300 * points[:, :2] / points[:, 2:] + 160
    moved = points + np.array([0.4, 0.02, -0.3])
    second = 300 * moved[:, :2] / moved[:, 2:] + 160
    wrong = rng.uniform(0, 320, (40, 2))
    assert epipolar(first, second) == 60
    mixed = epipolar(np.vstack([first, rng.uniform(0, 320, (40, 2))]), np.vstack([second, wrong]))
    assert 58 <= mixed <= 70
    assert epipolar(first[:7], second[:7]) == 0


def test_ratios_are_of_the_pairs_that_floats_match():
    floats = KeptMatches([100, 50, 3], [110, 60, 40], [10, 10, 10], ["a"] * 3)
    own = KeptMatches([90, 10, 30], [100, 40, 40], [1, 2, 3], ["a"] * 3)
    one = figures({"float sift": floats, "ours": own})["ours"]
    assert one["inliers_ratio"] == pytest.approx(100 / 150, abs=1e-4)
    assert one["pairs_matched_ratio"] == pytest.approx(2 / 2)
    assert one["precision"] == pytest.approx(100 / 140, abs=1e-4)
    assert one["bytes"] == 2


def test_a_node_has_150_landmarks():
    full, half = Packed(2800, 150, 2500, 2.0, 1.0), Packed(1550, 75, 1250, 1.0, 1.0)
    assert node_figures([full, half])["bytes_per_node"] == 2800
    reckoned = node_figures([half])
    assert (reckoned["bytes_per_node"], reckoned["nodes_of_150"]) == (2800, 0)
    assert reckoned["bytes_per_landmark"] == pytest.approx(16.667, abs=1e-3)


def test_the_folder_is_checked_first(tmp_path):
    with pytest.raises(InvalidFile, match="no such folder"):
        folder_pairs(tmp_path / "nothing", 0, 10)
