"""Views: images that will become nodes once their landmarks are known."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features


@dataclass(frozen=True, eq=False)
class RawImage:
    """An image of the camera, with the lens's distortion still in it.

    Attributes:
        pixels: (H, W) grey.
        lens: through which it was seen.
    """

    pixels: NDArray[np.uint8]
    lens: Lens


@dataclass(eq=False)
class PendingKeyframe:
    """An image that will become a node.

    Attributes:
        stamp_ns: when it was taken.
        anchor_from_view: pose relative to the anchor view; identity for the anchor itself.
        features: its features.
        tracks: (N,) id of the track of each feature, -1 where it has none.
        proximity: (K,) m, free distances from the robot's edge at that time.
        image: of which the features are; None if it is not known.
    """

    stamp_ns: int
    anchor_from_view: PoseGaussian
    features: Features
    tracks: NDArray[np.int64]
    proximity: Array = field(default_factory=lambda: np.zeros(0))
    image: RawImage | None = None


def associate(features: Features, ids: NDArray[np.int64], raw: Array, within_px: float) -> NDArray[np.int64]:
    """Match features with tracked points: mutually nearest, and near.

    Args:
        features: of an image.
        ids: (M,) of the tracks.
        raw: (M, 2) px in the real image, where the tracks are in it.
        within_px: how near.

    Returns:
        (N,) id of the track of each feature, -1 where it has none.
    """
    tracks = np.full(len(features), -1, np.int64)
    if len(features) and len(ids):
        distance = np.linalg.norm(features.raw[:, None] - raw[None], axis=2)
        nearest = distance.argmin(axis=1)
        mutual = distance.argmin(axis=0)[nearest] == np.arange(len(features))
        same = mutual & (distance.min(axis=1) <= within_px)
        tracks[same] = ids[nearest[same]]
    return tracks


def even_choice(candidates: Array, taken: Array, most: int) -> NDArray[np.int64]:
    """Choose pixels far from each other and from those taken, by farthest-point sampling.

    Args:
        candidates: (N, 2) px, strongest first.
        taken: (M, 2) px.
        most: how many to choose.

    Returns:
        (K,) indices of the candidates.
    """
    distance = np.full(len(candidates), np.inf)
    if len(taken):
        distance = np.linalg.norm(candidates[:, None] - taken[None], axis=2).min(axis=1)
    chosen: list[int] = []
    while len(chosen) < min(most, len(candidates)):
        best = int(distance.argmax())
        chosen.append(best)
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[best], axis=1))
        distance[best] = -1.0
    return np.array(chosen, np.int64)
