"""How often a view is recognised, over what the node may cost: the landmarks chosen, or simply the
strongest.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from benchmarks.landmarks.places import SimulatedPlace
from benchmarks.landmarks.rivals import DEPTH_FLOOR
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.query import View
from mapweave.registration.recognition import Recognition, examine_view
from mapweave.registration.selection import SelectionSettings, choose, worth
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

BUDGETS = (700, 850, 1000, 1200, 1500, 2000, 2500, 3000)
QUERIES = 4
LEAST_LANDMARKS = 60
"""A place with fewer has nothing to choose from."""

FOUND_M, FOUND_RAD = 0.25, math.radians(5.0)
AGAIN_PX = 2.5
EPISODE = (Pose2(0.25, 0.0, 0.03), Pose2(-0.2, 0.0, -0.04), Pose2(0.1, 0.0, 0.08))
"""Where a robot that maps has looked from besides, seen from the node."""

LABELS = {"chosen": "chosen", "strongest": "the strongest"}


@dataclass(frozen=True, eq=False)
class MappedSite:
    """A place as a robot has mapped it, and views that ask for it.

    Attributes:
        camera: that sees.
        every: candidates, strongest first.
        likely: (N,) how likely each is found again.
        views: what was seen, and from where, seen from the place.
    """

    camera: Camera
    every: Landmarks
    likely: Array
    views: tuple[tuple[View, Pose2], ...]


def recall_curve(seed: int, places: int, console: Console) -> dict[str, dict[str, float]]:
    """Share of the views that are recognised where they are, by what is kept and what it may cost."""
    rng = np.random.default_rng([seed, 4])
    found = {way: dict.fromkeys(BUDGETS, 0) for way in LABELS}
    asked = 0
    for _ in track(range(places), "places", console=console):
        site = _site(rng)
        asked += len(site.views)
        for way, by_budget in found.items():
            for budget in BUDGETS:
                by_budget[budget] += _recognised(site, _kept(site, way, budget))
    return {
        way: {str(budget): round(hits / asked, 4) for budget, hits in by_budget.items()}
        for way, by_budget in found.items()
    }


def _kept(site: MappedSite, way: str, budget: int) -> NDArray[np.int64]:
    chosen = choose(site.every, site.likely, site.camera, SelectionSettings(budget))
    # As many landmarks, which cost as much.
    return chosen if way == "chosen" else np.arange(len(chosen))


def _recognised(site: MappedSite, kept: NDArray[np.int64]) -> int:
    """How many of the views are recognised, and rightly."""
    landmarks, _ = settle(site.every.take(kept), site.camera)
    here = PoseGaussian(Pose2(), np.zeros((3, 3)))
    node = Node(NodeId("r0", 1, 1), 0, here, site.camera, landmarks)
    hits = 0
    for view, truth in site.views:
        verdict = examine_view(node, view, None, np.random.default_rng(0))
        if isinstance(verdict, Recognition):
            off = truth.inverse() @ verdict.node_from_robot.mean
            hits += math.hypot(off.x, off.y) < FOUND_M and abs(off.heading) < FOUND_RAD
    return hits


def _site(rng: np.random.Generator) -> MappedSite:
    """The next place that shows enough."""
    while True:
        place = SimulatedPlace.draw(rng)
        sift = Sift(Lens(place.description.camera, place.description.distortion))
        features = sift.extract(place.picture())
        raw = features.raw
        pixels = place.undistorted(raw)
        true, points = place.depths(pixels), place.points(pixels)
        seen = np.mean([_again(place, points, sift, at) for at in EPISODE], axis=0)
        sigmas = np.hypot(DEPTH_FLOOR[0], DEPTH_FLOOR[1] * true)
        depths = true + sigmas * rng.standard_normal(len(true))
        with np.errstate(invalid="ignore"):
            good = np.flatnonzero(depths > 0.05)
        if len(good) < LEAST_LANDMARKS:
            continue
        every = Landmarks(
            pixels[good].astype(np.float32), features.codes[good],
            depths[good].astype(np.float32), sigmas[good].astype(np.float32),
        )  # fmt: skip
        likely = worth(seen[good], good / len(features))
        return MappedSite(place.camera, every, likely, tuple(_view(place, sift, rng) for _ in range(QUERIES)))


def _again(place: SimulatedPlace, points: Array, sift: Sift, at: Pose2) -> NDArray[np.bool_]:
    """(N,) which points have a feature where they are seen from beside the place."""
    other = place.undistorted(sift.extract(place.picture(at)).raw)
    expected = place.project(points, at)
    if not len(other):
        return np.zeros(len(points), bool)
    away = np.linalg.norm(expected[:, None] - other[None], axis=2)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nan_to_num(away, nan=np.inf).min(axis=1) < AGAIN_PX)


def _view(place: SimulatedPlace, sift: Sift, rng: np.random.Generator) -> tuple[View, Pose2]:
    at = place.nearby(rng)
    features = sift.extract(place.picture(at))
    pixels = place.undistorted(features.raw).astype(np.float32)
    return View(pixels, features.codes, place.camera), at
