"""Which landmarks a node keeps: those that will be found again, all over the image, and unlike each other.

A landmark's worth depends on how well it was tracked, and is lowered by those already selected: a second
landmark at the same spot adds little, since a pose is determined by spread. So they are selected greedily,
always the one of highest worth, until the node's byte budget is used.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.descriptor import decode, rounding_noise
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.landmark_tables import DIMENSIONS, TOTAL_BITS, landmark_tables
from mapweave.hybridmap.node import Landmarks
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.quantization import FINE_BITS, PixelGrid, round_depths
from mapweave.registration.matching import squared_distances

FIXED_BYTES = 330
"""A node without landmarks: names, pose, camera, 16 ranges, checksums and the transport's frame."""

LANE_BITS = 3.25
"""What a landmark costs at most beyond the logarithms of its numbers: whole bits, and the row it is in."""

DOUBT = 0.3
"""A landmark that was not seen again keeps some worth: the robot may just have turned away."""


@dataclass(frozen=True)
class SelectionSettings:
    """How many landmarks a node keeps, and which.

    Attributes:
        most_bytes: what a node may cost on the wire without its trajectory segment, bytes; at least 660.
    """

    most_bytes: int = 3000

    def __post_init__(self) -> None:
        """Refuse what leaves no room for a node.

        Raises:
            InvalidValue: a number out of range.
        """
        if self.most_bytes < 2 * FIXED_BYTES:
            raise InvalidValue(f"most_bytes: a node needs {2 * FIXED_BYTES} at least, not {self.most_bytes}")


def worth(seen: NDArray[Any], rank: NDArray[Any]) -> Array:
    """How likely landmarks are found again, (N,), up to a factor.

    Args:
        seen: (N,) share of the images since the view in which each was followed or found, 0 to 1.
        rank: (N,) how many of the view's features are stronger, as a share, 0 to 1.
    """
    likely: Array = (DOUBT + seen) * np.sqrt(1.5 - rank)
    return likely


CROWD = 0.08
"""Landmarks nearer to each other than about this share of the image's width crowd each other."""
ALIKE = 0.5
"""Distance of two decoded descriptors beyond which they cannot be taken for each other."""


def choose(
    landmarks: Landmarks,
    likely: NDArray[Any],
    camera: Camera,
    settings: SelectionSettings | None = None,
    most: int | None = None,
) -> NDArray[np.int64]:
    """Choose landmarks, the best first.

    Args:
        landmarks: N candidates.
        likely: (N,) positive, how likely each is found again, see `worth`.
        camera: that saw them.
        settings: what they may cost.
        most: so many at most; any number if None.

    Returns:
        (K,) int64, indices; as many as fit.
    """
    s = settings or SelectionSettings()
    most = len(landmarks) if most is None else min(most, len(landmarks))
    order = _ranked(landmarks.pixels / camera.width, likely * distinctness(landmarks, ALIKE), CROWD, most)
    fits = _bytes_of_first(landmarks.take(order), camera) <= s.most_bytes
    return order[: int(fits.sum())]


def distinctness(landmarks: Landmarks, alike: float) -> Array:
    """(N,) distance of each descriptor to the nearest other as a share of what is far enough, 1 at most."""
    vectors = decode(landmarks.codes)
    squared = squared_distances(vectors, vectors).astype(np.float64) - rounding_noise()
    np.fill_diagonal(squared, np.inf)
    nearest = np.sqrt(np.maximum(squared.min(axis=1, initial=np.inf), 0.0))
    distinct: Array = np.minimum(nearest / alike, 1.0)
    return distinct


def _ranked(places: Array, value: Array, crowd: float, most: int) -> NDArray[np.int64]:
    """The first indices in greedy order of worth, given those before."""
    x, y = places.T
    away = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    crowding = np.exp(away / (-2 * crowd**2))
    crowded, left = np.ones(len(places)), np.array(value, np.float64)
    order = np.empty(most, np.int64)
    for k in range(most):
        order[k] = best = int((left / crowded).argmax())
        crowded += crowding[best]
        left[best] = -1.0
    return order


def _bytes_of_first(landmarks: Landmarks, camera: Camera) -> Array:
    """(N,) what a node with the first 1, 2 ... N landmarks costs at most."""
    t, steps = landmark_tables(), 2.0 ** PixelGrid.of(camera).shift
    share, depth = round_depths(landmarks.depths, landmarks.depth_sigmas)
    fine, with_depth = FINE_BITS[share], share > 0
    codes = (TOTAL_BITS - np.log2(t.codes[np.arange(DIMENSIONS), landmarks.codes])).sum(axis=1)
    cells = np.where(with_depth, TOTAL_BITS - np.log2(np.maximum(t.cells[depth >> fine], 1)) + fine, 0.0)
    shares = TOTAL_BITS - np.log2(t.shares[share])
    count = np.arange(1, len(landmarks) + 1)
    # By rows, a landmark's y costs its share of the image only.
    pixel = np.log2(camera.width * steps) + np.log2(np.maximum(camera.height * steps / count, 1)) + LANE_BITS
    bits: Array = np.cumsum(codes + cells + shares) + count * pixel
    return FIXED_BYTES + np.ceil(bits / 8)
