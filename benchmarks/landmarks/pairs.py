"""Pairs of images that show the same: photographs of a folder, known warps, and simulated rooms."""

import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.images.known_warps import HELD_OUT, Image, load, shrunk, warp
from benchmarks.images.printed_matter import printed_page
from benchmarks.landmarks.places import SimulatedPlace
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.pose import Array

SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}
RIGHT_PX = 3.0
EPIPOLAR_PX = 1.5
APART = 0.03
"""m; two rays that meet surfaces further apart than this do not see the same point."""

Judge = Callable[[Array, Array], int]
"""(K, 2) px in the first image and (K, 2) px in the second, matched: how many are right."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images of the same thing.

    Attributes:
        source: what kind of images they are.
        first: (H, W) grey.
        second: likewise.
        camera: that took the first.
        right: tells how many matches are right.
        depths: gives the depth of pixels (N, 2) of the first image, (N,) m; None if unknown.
    """

    source: str
    first: Image
    second: Image
    camera: Camera
    right: Judge
    depths: Callable[[Array], Array] | None = None


def camera_of(image: Image) -> Camera:
    """Some camera with images of this size; nothing here depends on its focal length."""
    height, width = image.shape
    return Camera(width, height, 0.87 * width, 0.87 * width, (width - 1) / 2, (height - 1) / 2, 0.3)


def epipolar(first: Array, second: Array) -> int:
    """Matches that agree on one fundamental matrix, by RANSAC."""
    if len(first) < 8:
        return 0
    cv2.setRNGSeed(1)
    _, agreed = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, EPIPOLAR_PX, 0.999, 3000)
    return 0 if agreed is None else int(agreed.sum())


def folder_pairs(folder: Path, seed: int, most: int) -> list[Pair]:
    """Pairs of a folder of photographs of one scene: all, or neighbours by name and others by chance.

    Raises:
        InvalidFile: it is no folder, or has fewer than two photographs.
    """
    if not folder.is_dir():
        raise InvalidFile(f"{folder}: no such folder")
    images = []
    for path in sorted(folder.iterdir(), key=_by_number):
        if path.suffix.lower() in SUFFIXES:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                print(f"landmarks: {path} is no image that can be read; left out", file=sys.stderr)
            else:
                images.append(shrunk(image))
    if len(images) < 2:
        raise InvalidFile(f"{folder}: {len(images)} photographs, at least 2 of one scene are needed")
    chosen = list(combinations(range(len(images)), 2))
    if len(chosen) > most:
        rng = np.random.default_rng(seed)
        near = [(k, k + 1) for k in range(len(images) - 1)]
        far = [pair for pair in chosen if pair[1] - pair[0] > 1]
        chosen = [near[k] for k in rng.permutation(len(near))] + [far[k] for k in rng.permutation(len(far))]
    return [
        Pair("photographs", images[a], images[b], camera_of(images[a]), epipolar)
        for a, b in sorted(chosen[:most])
    ]


def _by_number(path: Path) -> list[str | int]:
    """So that 10.jpg comes after 9.jpg."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def known_pairs(seed: int, count: int) -> Iterator[Pair]:
    """Half of them held-out images and pages under known warps, half simulated rooms from two poses."""
    rng = np.random.default_rng([seed, 1])
    images = [load(name) for name in HELD_OUT] + [printed_page(rng) for _ in HELD_OUT]
    for number in range(count):
        if number % 2:
            yield _room_pair(np.random.default_rng([seed, 2, number]))
        else:
            yield _warped_pair(images[number // 2 % len(images)], rng)


def _warped_pair(image: Image, rng: np.random.Generator) -> Pair:
    other, b_from_a = warp(image, rng)

    def right(first: Array, second: Array) -> int:
        if not len(first):
            return 0
        at = cv2.perspectiveTransform(np.asarray(first, np.float64)[:, None], b_from_a)[:, 0]
        return int((np.linalg.norm(at - second, axis=1) < RIGHT_PX).sum())

    return Pair("known warps", image, other, camera_of(image), right)


def _room_pair(rng: np.random.Generator) -> Pair:
    place = SimulatedPlace.draw(rng)
    first_from_second = place.nearby(rng)
    images = place.picture(), place.picture(first_from_second)

    def right(first: Array, second: Array) -> int:
        if not len(first):
            return 0
        at = place.points(place.undistorted(first))
        on = place.points(place.undistorted(second), first_from_second)
        return int((_apart(at, on) < APART).sum())

    def depths(pixels: Array) -> Array:
        return place.depths(place.undistorted(pixels))

    return Pair("simulated rooms", *images, place.camera, right, depths)


def _apart(a: Array, b: Array) -> NDArray[np.float64]:
    """Distances; infinite where either is not there."""
    apart: Array = np.linalg.norm(a - b, axis=1)
    return np.where(np.isfinite(apart), apart, np.inf)
