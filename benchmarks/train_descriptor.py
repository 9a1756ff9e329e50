"""The making of the tables that code landmarks (hybridmap/landmarks_v2.npz).

    python -m benchmarks.train_descriptor [--json]    train, and compare with the tables that are shipped
    python -m benchmarks.train_descriptor --write     train, and store

Trained on images that scikit-image ships and that are in the public domain or CC0, on generated printed
matter and on views of the simulator's rooms. What comes out on one machine is always the same. How good the
tables are is measured by `python -m benchmarks.landmarks`, on other images.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

import hybridmap
from benchmarks.known_warps import HELD_OUT, TRAINED_ON, Image, load, warp
from benchmarks.printed_matter import printed_page
from benchmarks.tracking_scenes import room_drive
from hybridmap.descriptor import project, quantise, root_sift
from hybridmap.grid import CELLS, CELLS_PER_E, DEPTH_LEAST, SHARE_LEAST, SHARES_PER_E
from hybridmap.landmark_tables import (
    DIMENSIONS,
    FILE,
    SYMBOLS,
    TOTAL_BITS,
    VERSION,
    LandmarkTables,
    landmark_tables,
)
from hybridmap.pose import Array

SEED = 20090628
PRINTED_PAGES = 12
WARPS = 6
ROOMS = 40
FEATURES = 700

STEP = 0.035
"""Finer steps keep hardly more matches, see docs/decisions/landmarks.md."""

SMOOTHING = 0.01
"""Share of each column's frequencies that is spread widely: other images have other tails."""

DEPTH_MEDIAN, DEPTH_SPREAD = 2.0, 0.8
"""m, and in its logarithm: rooms, and halls a few times as large."""

SHARE_FLOOR, SHARE_DECAY, UNKNOWN = 0.02, 0.6, 0.02
"""Depths are seldom known better than to 2 %, e times as badly is 5 times as rare, and some not at all."""


def sift_of(image: Image) -> NDArray[np.float32]:
    """(N, 128) descriptors."""
    detector = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.02)  # type: ignore[attr-defined]
    found = detector.detectAndCompute(image, None)[1]
    return np.zeros((0, 128), np.float32) if found is None else np.asarray(found, np.float32)


def training_images() -> list[Image]:
    """Photographs and pages, and each from elsewhere."""
    rng = np.random.default_rng(SEED)
    images = [load(name) for name in TRAINED_ON] + [printed_page(rng) for _ in range(PRINTED_PAGES)]
    return [seen for image in images for _ in range(WARPS) for seen in (image, warp(image, rng)[0])]


def room_images() -> list[Image]:
    """Views of simulated rooms."""
    rng = np.random.default_rng(SEED + 1)
    return [room_drive(rng, 1).images[0] for _ in track(range(ROOMS), "rooms")]


def train() -> LandmarkTables:
    """Make the tables; always the same ones."""
    images = np.concatenate([sift_of(image) for image in track(training_images(), "training images")])
    mean, basis = principal_axes(root_sift(images).astype(np.float64))
    bare = np.full((DIMENSIONS, SYMBOLS), (1 << TOTAL_BITS) // SYMBOLS)
    tables = LandmarkTables(mean, basis, STEP, bare, share_frequencies(), cell_frequencies())
    rooms = np.concatenate([sift_of(image) for image in room_images()])
    # As many of both kinds: a robot sees rooms, but nobody knows which.
    codes = [quantise(project(sift, tables), tables) for sift in (images, rooms)]
    shares = [np.array([np.bincount(c[:, k], minlength=SYMBOLS) for k in range(DIMENSIONS)]) for c in codes]
    counts = sum(s / s.sum(axis=1, keepdims=True) for s in shares) / 2
    frequencies = np.array([whole_frequencies(widened(row)) for row in counts])
    return LandmarkTables(mean, basis, STEP, frequencies, tables.shares, tables.cells)


def principal_axes(roots: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and the axes of greatest spread, in half precision as they are stored."""
    mean = roots.mean(axis=0)
    centred = roots - mean
    _, vectors = np.linalg.eigh(centred.T @ centred)
    basis = vectors[:, ::-1][:, :DIMENSIONS]
    basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(DIMENSIONS)])
    return mean.astype(np.float32), basis.astype(np.float16).astype(np.float32)


def widened(shares: Array) -> Array:
    """A column's shares with a little of a Cauchy distribution of the same middle and width."""
    symbols = np.arange(SYMBOLS)
    middle = float(shares @ symbols)
    width = max(1.0, float(np.sqrt(shares @ (symbols - middle) ** 2)))
    wide = 1.0 / (1.0 + ((symbols - middle) / width) ** 2)
    mixed: Array = (1 - SMOOTHING) * shares + SMOOTHING * wide / wide.sum()
    return mixed


def whole_frequencies(shares: Array) -> NDArray[np.int64]:
    """Whole numbers that sum to 2^12, at least 1 where there is a share at all."""
    total = 1 << TOTAL_BITS
    out = np.where(shares > 0, np.maximum(1, np.floor(shares / shares.sum() * total)), 0).astype(np.int64)
    # What rounding left over goes to, or is taken from, the most frequent: there it weighs least.
    out[out.argmax()] += total - out.sum()
    return out


def cell_frequencies() -> NDArray[np.int64]:
    """Depths: log-normal, with a little of anything."""
    cells = np.arange(SYMBOLS)
    middle = CELLS_PER_E * np.log(DEPTH_MEDIAN / DEPTH_LEAST)
    likely = np.exp(-0.5 * ((cells + 0.5 - middle) / (CELLS_PER_E * DEPTH_SPREAD)) ** 2)
    return whole_frequencies(np.where(cells < CELLS, likely / likely.sum() + 0.0005, 0.0))


def share_frequencies() -> NDArray[np.int64]:
    """Uncertainty: exponential above a floor, steep below it, a little of anything."""
    steps = (np.arange(1, SYMBOLS) - 1) / SHARES_PER_E + np.log(SHARE_LEAST / SHARE_FLOOR)
    likely = np.exp(np.where(steps < 0, 4 * steps, -steps / SHARE_DECAY))
    known = (1 - UNKNOWN) * (likely / likely.sum() + 0.0003)
    return whole_frequencies(np.concatenate([[UNKNOWN], known]))


def bits_of(codes: NDArray[np.uint8], tables: LandmarkTables) -> float:
    """Bits of a descriptor on average."""
    frequencies = tables.codes[np.arange(DIMENSIONS), codes]
    return float((TOTAL_BITS - np.log2(frequencies)).sum(axis=1).mean())


def compared(tables: LandmarkTables) -> dict[str, Any]:
    """What trained tables cost, and how far they are from the shipped ones."""
    rng = np.random.default_rng(SEED + 2)
    rooms = np.concatenate([sift_of(room_drive(rng, 1).images[0]) for _ in range(10)])
    held_out = np.concatenate([sift_of(load(name)) for name in HELD_OUT])
    trained = np.concatenate([sift_of(load(name)) for name in TRAINED_ON])
    bits = {
        f"bits_{name}": bits_of(quantise(project(sift, tables), tables), tables)
        for name, sift in (("trained_on", trained), ("held_out", held_out), ("other_rooms", rooms))
    }
    shipped = landmark_tables()
    away = float(np.abs(tables.basis - shipped.basis).max())
    return {**bits, "step": tables.step, "basis_off_shipped": away,
            "frequencies_off_shipped": int(np.abs(tables.codes - shipped.codes).max())}  # fmt: skip


def store(tables: LandmarkTables) -> Path:
    """Write the file that the package ships."""
    path = Path(hybridmap.__path__[0]) / FILE
    np.savez_compressed(
        path, version=np.int64(VERSION), mean=tables.mean, basis=tables.basis.astype(np.float16),
        step=np.float64(tables.step), codes=tables.codes.astype(np.uint16),
        shares=tables.shares.astype(np.uint16), cells=tables.cells.astype(np.uint16),
    )  # fmt: skip
    landmark_tables.cache_clear()
    return path


def main() -> None:
    """Train, and compare or store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="store the tables")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    tables = train()
    if arguments.write:
        path = store(tables)
        console.print(f"wrote {path.name}, {path.stat().st_size} bytes")
    figures = compared(tables)
    for name, value in figures.items():
        console.print(f"{name:24} {value:.4g}")
    if arguments.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
