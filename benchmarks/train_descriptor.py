"""How much of SIFT survives in 16 bytes, and the making of the table that does it.

    python -m benchmarks.train_descriptor [--seed N] [--pairs N] [--json]   measure the shipped table
    python -m benchmarks.train_descriptor --write                           train it again and store it

Trained on images that scikit-image ships and that are in the public domain or CC0, and on generated printed
matter. Measured on images that were not trained on, warped by known homographies, so that a match is right or
wrong without asking another estimator.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import skimage.data
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table as PrintedTable

import hybridmap
from benchmarks.printed_matter import printed_page
from hybridmap.descriptor import DIMENSIONS, LEVELS, TABLE_NAME, TABLE_VERSION, Table, root_sift, table
from hybridmap.matching import MatchSettings, match_vectors
from hybridmap.pose import Array

Image = NDArray[np.uint8]

# Public domain or CC0, each says so in its docstring in skimage.data.
TRAINED_ON = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket", "clock")
HELD_OUT = ("coins", "page", "text", "moon", "retina", "hubble_deep_field")
TRAINING_SEED = 20090628
PRINTED_PAGES = 12
WARPS = 6


@dataclass(frozen=True)
class Warped:
    """One image under a known homography, with SIFT of both.

    Attributes:
        pixels_a: (N, 2) px.
        sift_a: (N, 128).
        pixels_b: (M, 2) px.
        sift_b: (M, 128).
        b_from_a: (3, 3) homography.
    """

    pixels_a: Array
    sift_a: NDArray[np.float32]
    pixels_b: Array
    sift_b: NDArray[np.float32]
    b_from_a: Array

    def right(self, pairs: NDArray[np.int64], tolerance_px: float = 3.0) -> int:
        """How many pairs agree with the homography."""
        if len(pairs) == 0:
            return 0
        where = cv2.perspectiveTransform(self.pixels_a[pairs[:, 0]][:, None], self.b_from_a)[:, 0]
        return int((np.linalg.norm(where - self.pixels_b[pairs[:, 1]], axis=1) < tolerance_px).sum())


def load(name: str) -> Image:
    """One of scikit-image's images, grey, at most 640 px wide."""
    image: Any = getattr(skimage.data, name)()
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = 640 / max(image.shape)
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image, dtype=np.uint8)


def warp(image: Image, rng: np.random.Generator) -> tuple[Image, Array]:
    """See the image from elsewhere: turned, nearer or further, oblique, darker, blurred and noisy."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    angle, scale = rng.normal(0, np.deg2rad(7)), np.exp(rng.uniform(np.log(0.55), np.log(1.5)))
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([width, height]) / 2
    moved = (corners - centre) @ turn.T + centre + rng.normal(0, 0.06, (4, 2)) * [width, height] * scale
    b_from_a = cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))
    warped = cv2.warpPerspective(image, b_from_a, (width, height), flags=cv2.INTER_AREA)
    out = cv2.GaussianBlur(warped, (0, 0), rng.uniform(0.3, 1.2)).astype(np.float64)
    out = out * rng.uniform(0.6, 1.2) + rng.uniform(-20, 20) + rng.normal(0, rng.uniform(1, 5), out.shape)
    return np.clip(out, 0, 255).astype(np.uint8), np.asarray(b_from_a, dtype=np.float64)


def make_pair(image: Image, rng: np.random.Generator, features: int) -> Warped | None:
    """SIFT of an image and of the same image warped; None if one shows next to nothing."""
    detector = cv2.SIFT_create(nfeatures=features, contrastThreshold=0.02)  # type: ignore[attr-defined]
    other, b_from_a = warp(image, rng)
    keypoints_a, sift_a = detector.detectAndCompute(image, None)
    keypoints_b, sift_b = detector.detectAndCompute(other, None)
    if len(keypoints_a) < 10 or len(keypoints_b) < 10:
        return None
    pixels = [np.array([k.pt for k in keypoints]) for keypoints in (keypoints_a, keypoints_b)]
    return Warped(pixels[0], sift_a, pixels[1], sift_b, b_from_a)


def train() -> Table:
    """Make the table; always the same one."""
    rng = np.random.default_rng(TRAINING_SEED)
    images = [load(name) for name in TRAINED_ON] + [printed_page(rng) for _ in range(PRINTED_PAGES)]
    samples = []
    for image in track(images, "training images"):
        for _ in range(WARPS):
            pair = make_pair(image, rng, features=700)
            if pair is not None:
                samples += [pair.sift_a, pair.sift_b]
    roots = root_sift(np.concatenate(samples)).astype(np.float64)
    mean = roots.mean(axis=0)
    centred = roots - mean
    _, vectors = np.linalg.eigh(centred.T @ centred)
    basis = vectors[:, ::-1][:, :DIMENSIONS]
    basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(DIMENSIONS)])
    basis16 = basis.astype(np.float16).astype(np.float32)
    projected = (centred @ basis16).astype(np.float64)
    levels = np.stack([lloyd_max(projected[:, k]) for k in track(range(DIMENSIONS), "levels")])
    return Table(mean.astype(np.float32), basis16, levels.astype(np.float32))


def lloyd_max(values: Array, rounds: int = 60) -> Array:
    """(16,) ascending levels with the least mean squared rounding error (Lloyd 1982), from quantiles."""
    values = np.sort(values)
    total = np.concatenate([[0.0], np.cumsum(values)])
    levels = np.quantile(values, (np.arange(LEVELS) + 0.5) / LEVELS)
    for _ in range(rounds):
        cuts = np.searchsorted(values, 0.5 * (levels[1:] + levels[:-1]))
        cuts = np.concatenate([[0], cuts, [len(values)]])
        levels = np.diff(total[cuts]) / np.maximum(np.diff(cuts), 1)
    return levels


def measure(the_table: Table, seed: int, pairs: int, features: int) -> dict[str, Any]:
    """Right matches with codes as a share of those with full float RootSIFT, same matcher, same input."""
    rng = np.random.default_rng(seed)
    images = [load(name) for name in HELD_OUT] + [printed_page(rng) for _ in range(len(HELD_OUT))]
    settings = MatchSettings()
    kept, precision_full, precision_code, right_full, right_code = [], [], [], 0, 0
    for k in track(range(pairs), "held-out pairs"):
        pair = make_pair(images[k % len(images)], rng, features)
        if pair is None:
            continue
        full = match_vectors(root_sift(pair.sift_a), root_sift(pair.sift_b), settings).pairs
        codes = [the_table.quantise(the_table.project(s)) for s in (pair.sift_a, pair.sift_b)]
        code = match_vectors(the_table.restore(codes[0]), the_table.restore(codes[1]), settings).pairs
        ours, theirs = pair.right(code), pair.right(full)
        if theirs < 10:
            continue
        right_full, right_code = right_full + theirs, right_code + ours
        kept.append(ours / theirs)
        precision_full.append(theirs / len(full))
        precision_code.append(ours / max(len(code), 1))
    return {
        "pairs": len(kept),
        "inliers_kept": right_code / max(right_full, 1),
        "inliers_kept_worst_tenth": float(np.quantile(kept, 0.1)),
        "precision_full": float(np.mean(precision_full)),
        "precision_code": float(np.mean(precision_code)),
        "bytes_full": 512,
        "bytes_code": 16,
    }


def main() -> None:
    """Measure, or with --write train and store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=48)
    parser.add_argument("--features", type=int, default=200, help="features an image")
    parser.add_argument("--write", action="store_true", help="train the table again and store it")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    if arguments.write:
        trained = train()
        path = Path(hybridmap.__path__[0]) / TABLE_NAME
        np.savez_compressed(
            path,
            version=np.int64(TABLE_VERSION),
            mean=trained.mean,
            basis=trained.basis.astype(np.float16),
            levels=trained.levels,
        )
        table.cache_clear()
        console.print(f"wrote {path.name}, {path.stat().st_size} bytes")
    figures = measure(table(), arguments.seed, arguments.pairs, arguments.features)
    printed = PrintedTable("figure", "value")
    for name, value in figures.items():
        printed.add_row(name, f"{value:.3f}" if isinstance(value, float) else str(value))
    console.print(printed)
    if arguments.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
