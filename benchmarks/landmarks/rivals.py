"""Ways to keep a view so that it is recognised: our landmarks, SIFT in floats and bytes, ORB, and JPEG."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.images.known_warps import Image
from benchmarks.landmarks.pairs import Pair
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.descriptor import decode, encode, root_sift, rounding_noise
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.ranges import Ranges
from mapweave.registration.matching import MatchSettings, match_vectors
from mapweave.registration.selection import FIXED_BYTES
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from mapweave.wire.codec import decode_change, encode_change

FRAMING = 80
"""Bytes that Zenoh adds to a node: its key, and 16 bytes beside it."""

MOST = 150
POSITION_BYTES = 7
"""What rivals spend on pixel, depth and sigma: 2 + 2 + 2 + 1, as the first version of ours did."""

JPEG_QUALITY = 80
TIMES = 5
DEPTH_FLOOR = (0.01, 0.02)
"""m, and share of the depth: what a robot's depths are off by."""


@dataclass(frozen=True, eq=False)
class Kept:
    """One view, kept in one way.

    Attributes:
        pixels: (N, 2) px in the picture.
        vectors: (N, D) float32, compared by Euclidean distance.
        size: what it costs, bytes.
    """

    pixels: Array
    vectors: NDArray[np.float32]
    size: int


@dataclass(frozen=True, eq=False)
class Packed:
    """Our node on the wire.

    Attributes:
        size: bytes, framing included.
        landmarks: N.
        landmark_bytes: of its landmarks alone.
        encode_ms: for the whole change.
        decode_ms: likewise.
    """

    size: int
    landmarks: int
    landmark_bytes: int
    encode_ms: float
    decode_ms: float


def features(image: Image, camera: Camera) -> tuple[Array, NDArray[np.float32]]:
    """Pixels (N, 2) and SIFT (N, 128) of at most 150 features, chosen as robots choose them."""
    keypoints, sift = Sift(Lens(camera)).describe(image)
    return np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2), sift


def pack(pixels: Array, sift: NDArray[np.float32], pair: Pair, rng: np.random.Generator) -> Packed:
    """A node as a robot sends it, with 16 rangers.

    Depths are the simulator's, with a robot's errors; of photographs they are unknown, so they are
    drawn.
    """
    drawn = np.exp(rng.normal(np.log(2.0), 0.6, len(pixels)))
    depths = drawn if pair.depths is None else pair.depths(pixels)
    sigmas = np.hypot(DEPTH_FLOOR[0] + DEPTH_FLOOR[1] * depths, depths * rng.exponential(0.02, len(depths)))
    depths = np.maximum(depths + sigmas * rng.standard_normal(len(depths)), 0.05)
    every = Landmarks(
        pixels.astype(np.float32), encode(sift), depths.astype(np.float32), sigmas.astype(np.float32)
    )
    landmarks, _ = settle(every, pair.camera)
    pose = PoseGaussian.from_sigmas(Pose2(*rng.normal(0, 3, 3)), 0.03, 0.02)
    ranges = Ranges(rng.uniform(-3, 3, 16), rng.uniform(0.2, 3, 16), 3.0)
    node_id, stamp = NodeId("robot-0", 1, 1234), 1_700_000_000_123_456_789
    node = Node(node_id, stamp, pose, pair.camera, landmarks, "utc", 0.16, ranges)
    bare = Node(node_id, stamp, pose, pair.camera, landmarks.take(np.zeros(0, int)), "utc", 0.16, ranges)
    change = Change(node_id.map, 100_000, stamp, NodePut(node))
    data = encode_change(change)
    encode_ms, decode_ms = _least_ms(lambda: encode_change(change)), _least_ms(lambda: decode_change(data))
    without = len(encode_change(Change(node_id.map, 100_000, stamp, NodePut(bare))))
    return Packed(len(data) + FRAMING, len(landmarks), len(data) - without, encode_ms, decode_ms)


def _least_ms(act: Callable[[], object]) -> float:
    """How long it takes when nothing else disturbs."""
    times = []
    for _ in range(TIMES):
        start = time.perf_counter()
        act()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)


def matched(name: str, pair: Pair, first: Kept, second: Kept) -> tuple[int, int]:
    """How many features match, and how many of those are right: best in both directions, and distinct."""
    settings = MatchSettings()
    if name == "sift 128 bytes":
        settings = MatchSettings(most_distance=np.inf)
    elif name == "orb":
        # Squared distances of bits are Hamming's; the ratio is of those.
        settings = MatchSettings(ratio=settings.ratio**0.5, most_distance=np.inf)
    noise = rounding_noise() if name == "ours" else 0.0
    pairs = match_vectors(first.vectors, second.vectors, settings, noise)
    return len(pairs), pair.right(first.pixels[pairs[:, 0]], second.pixels[pairs[:, 1]])


def keep_all(
    pair: Pair, packed: Packed, found: list[tuple[Array, NDArray[np.float32]]]
) -> dict[str, list[Kept]]:
    """Both views, kept in every way; `found` are the features of the two."""
    kept: dict[str, list[Kept]] = {"float sift": [], "ours": [], "sift 128 bytes": [], "orb": []}
    for pixels, sift in found:
        count, roots = len(pixels), root_sift(sift)
        whole = FIXED_BYTES + count * POSITION_BYTES
        unit = (np.rint(sift).astype(np.uint8) / 512).astype(np.float32)
        kept["float sift"].append(Kept(pixels, roots, whole + 512 * count))
        kept["ours"].append(Kept(pixels, decode(encode(sift)), packed.size))
        kept["sift 128 bytes"].append(Kept(pixels, unit, whole + 128 * count))
    for image in (pair.first, pair.second):
        kept["orb"].append(_orb(image))
    for name, quality in (("jpeg", JPEG_QUALITY), ("jpeg squeezed", None)):
        # Only what is kept is squeezed; the view that asks is fresh.
        pixels, sift = found[1]
        kept[name] = [_jpeg(pair, packed.size, quality), Kept(pixels, root_sift(sift), 0)]
    return kept


def _orb(image: Image) -> Kept:
    detector = cv2.ORB_create(nfeatures=MOST)  # type: ignore[attr-defined]
    keypoints, codes = detector.detectAndCompute(image, None)
    if codes is None:
        codes = np.zeros((0, 32), np.uint8)
    pixels = np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2)
    size = FIXED_BYTES + len(pixels) * (32 + POSITION_BYTES)
    return Kept(pixels, np.unpackbits(codes, axis=1).astype(np.float32), size)


def _jpeg(pair: Pair, size: int, quality: int | None) -> Kept:
    """Features of the picture after JPEG; without a quality, as small as our node, or as JPEG gets."""
    qualities = (quality,) if quality is not None else (*range(95, 0, -5), 3, 1)
    for one in qualities:
        data = cv2.imencode(".jpg", pair.first, (cv2.IMWRITE_JPEG_QUALITY, one))[1]
        if len(data) + FIXED_BYTES <= size:
            break
    image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    pixels, sift = features(image, pair.camera)
    return Kept(pixels, root_sift(sift), len(data) + FIXED_BYTES)
