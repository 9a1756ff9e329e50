"""The making of the tables that code landmarks (hybridmap/landmarks.npz).

    python -m benchmarks.train_descriptor [--json]    train, and compare with the tables that are shipped
    python -m benchmarks.train_descriptor --write     train, and store

Trained on images that scikit-image ships and that are in the public domain or CC0, on generated printed
matter and on views of the simulator's rooms. What comes out on one machine is always the same. How good the
tables are is measured by `python -m benchmarks.landmarks`, on other images.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from benchmarks.images.known_warps import HELD_OUT, TRAINED_ON, Image, load, warp
from benchmarks.images.printed_matter import printed_page
from benchmarks.images.surface_points import Surfaces
from benchmarks.landmarks.places import LENSES, WORLDS
from mapweave import hybridmap
from mapweave.hybridmap.descriptor import project, quantise, root_sift
from mapweave.hybridmap.landmark_tables import (
    DIMENSIONS,
    FILE,
    SYMBOLS,
    TOTAL_BITS,
    VERSION,
    LandmarkTables,
    landmark_tables,
)
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.quantization import CELLS, CELLS_PER_E, DEPTH_LEAST, SHARE_LEAST, SHARES_PER_E
from mapweave.sim.camera import CAMERAS
from mapweave.sim.imager import Imager
from mapweave.sim.scene import Scene
from mapweave.sim.world import PanelSet
from mapweave.sim.worlds.catalog import make_world

SEED = 20090628
PRINTED_PAGES = 12
WARPS = 6
ROOMS = 40
FEATURES = 700

STEP = 0.035
"""Finer steps keep hardly more matches, see docs/decisions/landmarks.md."""

WHITENING = 0.5
"""0: principal components, 1: linear discriminants."""

FLOOR = 0.1
"""Share of the mean variance of change that is added to every direction: so much is not known of it."""

UNUSED = 6
"""Random numbers."""
CLEARANCE, LEAST_DEPTH, MEDIAN_DEPTH = 0.3, 0.4, (1.2, 4.5)
"""m, of the views of rooms: around the robot, and what they show at least and in the median."""

SAME_PX, SAME_DISTANCE = 3.0, 0.75
"""Features this near to each other are the same one, if they look alike at all."""

SMOOTHING = 0.01
"""Share of each column's frequencies that is spread widely: other images have other tails."""

DEPTH_MEDIAN, DEPTH_SPREAD = 2.0, 0.8
"""m, and in its logarithm: rooms, and halls a few times as large."""

SHARE_FLOOR, SHARE_DECAY, UNKNOWN = 0.02, 0.6, 0.02
"""Depths are seldom known better than to 2 %, e times as badly is 5 times as rare, and some not at all."""


def sift_of(image: Image) -> tuple[Array, NDArray[np.float32]]:
    """Pixels (N, 2) and descriptors (N, 128)."""
    detector = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.02)  # type: ignore[attr-defined]
    keypoints, found = detector.detectAndCompute(image, None)
    if found is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return np.array([k.pt for k in keypoints], np.float64), np.asarray(found, np.float32)


def warped_descriptors() -> tuple[NDArray[np.float32], Array]:
    """SIFT (N, 128) of photographs and pages, and what changes in RootSIFT (M, 128) when they are warped."""
    rng = np.random.default_rng(SEED)
    images = [load(name) for name in TRAINED_ON] + [printed_page(rng) for _ in range(PRINTED_PAGES)]
    every, changes = [], []
    for image in track(images, "training images"):
        pixels, sift = sift_of(image)
        for _ in range(WARPS):
            other, b_from_a = warp(image, rng)
            pixels_b, sift_b = sift_of(other)
            every += [sift, sift_b]
            at = cv2.perspectiveTransform(pixels[:, None], b_from_a)[:, 0]
            a, b = np.nonzero(np.linalg.norm(at[:, None] - pixels_b[None], axis=2) < SAME_PX)
            change = root_sift(sift[a]) - root_sift(sift_b[b])
            # Features of other sizes and orientations at the same place are others.
            changes.append(change[np.linalg.norm(change, axis=1) < SAME_DISTANCE])
    return np.concatenate(every), np.concatenate(changes).astype(np.float64)


def room_view(rng: np.random.Generator) -> Image:
    """(H, W) grey, what a robot sees of a simulated building through one of the simulator's cameras."""
    kind, lens = str(rng.choice(WORLDS)), str(rng.choice(LENSES))
    world, setup = make_world(kind, int(rng.integers(1 << 20))), CAMERAS[lens]
    # The tables that are shipped were made when further numbers were drawn here.
    rng.random(UNUSED)
    surfaces = Surfaces(world)
    grid = np.stack(np.meshgrid(np.arange(20, 320, 20.0), np.arange(20, 160, 20.0)), -1).reshape(-1, 2)
    while True:
        pose = world.plan.random_free_pose(rng, CLEARANCE)
        depths = surfaces.see(pose, setup.intrinsics, grid).depths
        if depths.min() > LEAST_DEPTH and MEDIAN_DEPTH[0] < np.median(depths) < MEDIAN_DEPTH[1]:
            break
    imager = Imager(setup, world.background, [int(rng.integers(1 << 30))])
    rotation = np.eye(3)
    rotation[:2, :2] = pose.rotation
    stands = np.array([pose.x, pose.y, 0.0]), rotation
    return imager.picture(Scene([PanelSet.of(world.panels)]), stands, 1.0, 0.0, 0.1)


def room_descriptors() -> NDArray[np.float32]:
    """SIFT (N, 128) of views of simulated rooms."""
    rng = np.random.default_rng(SEED + 1)
    views = [room_view(rng) for _ in track(range(ROOMS), "rooms")]
    return np.concatenate([sift_of(view)[1] for view in views])


def train() -> LandmarkTables:
    """Make the tables; always the same ones."""
    images, changes = warped_descriptors()
    mean, basis = telling_axes(root_sift(images).astype(np.float64), changes)
    bare = np.full((DIMENSIONS, SYMBOLS), (1 << TOTAL_BITS) // SYMBOLS)
    tables = LandmarkTables(mean, basis, STEP, bare, share_frequencies(), cell_frequencies())
    # As many of both kinds: a robot sees rooms, but it is unknown which.
    codes = [quantise(project(sift, tables), tables) for sift in (images, room_descriptors())]
    shares = [np.array([np.bincount(c[:, k], minlength=SYMBOLS) for k in range(DIMENSIONS)]) for c in codes]
    counts = sum(s / s.sum(axis=1, keepdims=True) for s in shares) / 2
    frequencies = np.array([whole_frequencies(widened(row)) for row in counts])
    return LandmarkTables(mean, basis, STEP, frequencies, tables.shares, tables.cells)


def telling_axes(roots: Array, changes: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and the axes that tell features apart, in half precision as they are stored.

    Half way between principal components and linear discriminants (Mikolajczyk and Matas, ICCV 2007):
    before the axes of greatest spread are taken, directions in which the same feature changes from view to
    view are shortened, by the fourth root of that variance. Then all are scaled to the spread of before.
    """
    mean = roots.mean(axis=0)
    spread = np.cov(roots.T)
    change = changes.T @ changes / (2 * len(changes))
    change += FLOOR * np.trace(change) / len(change) * np.eye(len(change))
    values, vectors = np.linalg.eigh(change)
    shorten = (vectors * values ** (-WHITENING / 2)) @ vectors.T
    _, axes = np.linalg.eigh(shorten @ spread @ shorten)
    basis = shorten @ axes[:, ::-1]
    basis *= np.sqrt(np.trace(spread) / np.trace(basis.T @ spread @ basis))
    basis = basis[:, :DIMENSIONS]
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
    rooms = np.concatenate([sift_of(room_view(rng))[1] for _ in range(10)])
    held_out = np.concatenate([sift_of(load(name))[1] for name in HELD_OUT])
    trained = np.concatenate([sift_of(load(name))[1] for name in TRAINED_ON])
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
        prog="python -m benchmarks.train_descriptor",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
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
