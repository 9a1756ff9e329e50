"""The making of the place index's cells (mapserver/retrieval/cells.npz).

    python -m benchmarks.train_cells [--images FOLDER ...] [--json]    how balanced the shipped cells are
    python -m benchmarks.train_cells --write                           learn them, and store them

Learned from what robots with the simulator's cameras see in simulated buildings, and from photographs that
scikit-image ships and that are in the public domain or CC0. What comes out on one machine is always the same.
The balance is measured on other buildings, on other photographs, and on the images in given folders.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from benchmarks.images.known_warps import HELD_OUT, TRAINED_ON, load, shrunk
from benchmarks.images.printed_matter import printed_page
from benchmarks.landmarks.places import LENSES, WORLDS
from benchmarks.relocalize.pictures import Photographer, Wish
from benchmarks.relocalize.places import CLEARANCE
from benchmarks.train_descriptor.benchmark import sift_of
from mapweave.hybridmap.descriptor import encode
from mapweave.hybridmap.landmark_tables import DIMENSIONS, VERSION
from mapweave.mapserver import retrieval
from mapweave.mapserver.retrieval.coarse_quantizer import (
    FAMILIES,
    FILE,
    CoarseQuantizer,
    Codes,
    Vectors,
    coarse_quantizers,
)
from mapweave.sim.worlds.catalog import make_world

SEED = 20090631
BUILDINGS, VIEWS = 64, 50
"""Buildings, and views of each: every kind of building with every camera, four times."""
PRINTED_PAGES = 12
OTHER_BUILDINGS, OTHER_VIEWS = 8, 25
"""For measuring."""
ROUNDS, HEAD_ROUNDS = 10, 20
"""Of k-means: for the centres of a family, and for the families' own centres."""
HEAD_SAMPLE = 200
"""Descriptors a family from which the families are learned."""


def seen(seed: int, buildings: int, views: int) -> Iterator[Codes]:
    """What robots see of buildings: (N, 32) codes, view by view; each kind with each of the cameras."""
    rng = np.random.default_rng(seed)
    for number in track(range(buildings), "buildings"):
        kind = WORLDS[number % len(WORLDS)]
        lens = LENSES[number // len(WORLDS) % len(LENSES)]
        world = make_world(kind, int(rng.integers(1 << 20)))
        photographer = Photographer(world, (seed, number), lens)
        for _ in range(views):
            yield photographer.take(Wish(world.plan.random_free_pose(rng, CLEARANCE))).view.codes


def photographed(names: tuple[str, ...]) -> Codes:
    """(N, 32) of scikit-image's photographs."""
    return np.concatenate([encode(sift_of(load(name))[1]) for name in names])


def examples() -> Codes:
    """(N, 32), all from which cells are learned, in random order."""
    rng = np.random.default_rng(SEED + 1)
    pages = [encode(sift_of(printed_page(rng))[1]) for _ in range(PRINTED_PAGES)]
    codes = np.concatenate([*seen(SEED, BUILDINGS, VIEWS), photographed(TRAINED_ON), *pages])
    shuffled: Codes = codes[rng.permutation(len(codes))]
    return shuffled


def learned(codes: Codes, families: int) -> CoarseQuantizer:
    """K-means twice: of all, and of each family.

    Args:
        codes: (N, 32) in random order.
        families: and centres in each.
    """
    import faiss

    vectors = codes.astype(np.float32)
    heads = _means(vectors[: HEAD_SAMPLE * families], families, HEAD_ROUNDS)
    family = faiss.knn(vectors, heads.astype(np.float32), 1)[1][:, 0]
    centres = [_means(vectors[family == k], families, ROUNDS) for k in range(families)]
    return CoarseQuantizer(heads, np.concatenate(centres))


def imbalance(quantizer: CoarseQuantizer, codes: Codes) -> float:
    """How many times as many landmarks share a landmark's cell as with equally full cells."""
    counts = np.bincount(quantizer.nearest(codes.astype(np.float32)), minlength=len(quantizer))
    return float(len(quantizer) * (counts * (counts - 1.0)).sum() / (len(codes) * (len(codes) - 1.0)))


def measured(folders: list[Path]) -> dict[str, Any]:
    """The imbalance of each size of cells, of images from which they were not learned."""
    kinds = {
        "other buildings": np.concatenate(list(seen(SEED + 2, OTHER_BUILDINGS, OTHER_VIEWS))),
        "other photographs": photographed(HELD_OUT),
    }
    for folder in folders:
        images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(folder.iterdir())]
        found = [encode(sift_of(shrunk(image))[1]) for image in images if image is not None]
        kinds[str(folder)] = np.concatenate([np.zeros((0, DIMENSIONS), np.uint8), *found])
    figures = {}
    for name, codes in kinds.items():
        if len(codes) > 1:
            sizes = {str(len(cells)): round(imbalance(cells, codes), 2) for cells in coarse_quantizers()}
            figures[name] = {"landmarks": len(codes), **sizes}
    return figures


def store(quantizers: dict[int, CoarseQuantizer]) -> Path:
    """Write the file that the package ships; each by the number of its families."""
    path = Path(retrieval.__path__[0]) / FILE
    arrays: dict[str, NDArray[Any]] = {}
    for families, quantizer in quantizers.items():
        arrays |= {f"heads{families}": quantizer.heads, f"centres{families}": quantizer.centres}
    np.savez_compressed(path, version=np.int64(VERSION), **arrays)  # type: ignore[arg-type]
    coarse_quantizers.cache_clear()
    return path


def main() -> None:
    """Learn and store, or measure."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.train_cells",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--write", action="store_true", help="store the cells")
    parser.add_argument(
        "--images", type=Path, nargs="+", default=[], metavar="FOLDER", help="of images to measure"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    if arguments.write:
        codes = examples()
        path = store({families: learned(codes, families) for families in FAMILIES})
        console.print(f"wrote {path.name} of {len(codes)} descriptors, {path.stat().st_size} bytes")
    figures = measured(arguments.images)
    for name, values in figures.items():
        console.print(f"{name:24} {values}")
    if arguments.json:
        print(json.dumps(figures))


def _means(vectors: Vectors, count: int, rounds: int) -> Codes:
    """(count, 32) means, in whole steps."""
    import faiss

    means = faiss.Kmeans(DIMENSIONS, count, niter=rounds, seed=SEED, min_points_per_centroid=1)
    means.train(vectors)
    codes: Codes = np.rint(np.asarray(means.centroids)).astype(np.uint8).reshape(-1, DIMENSIONS)
    return codes
