"""Landmarks on the wire: a second decoder written from docs/wire.md, sizes and damage."""

import math
import zlib
from contextlib import nullcontext
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import skimage.data
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.descriptor import encode
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.landmark_tables import landmark_tables
from mapweave.hybridmap.limits import MAX_LANDMARKS
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.ranges import Ranges
from mapweave.registration.selection import SelectionSettings, choose
from mapweave.wire.codec import encode_change
from mapweave.wire.landmark_codec import (
    MAX_LANDMARKS_BYTES,
    pack_features,
    pack_landmarks,
    unpack_features,
    unpack_landmarks,
)
from tests.hybridmap.kernel_forms import in_numpy
from tests.quick import first_quick
from tests.wire.plain_decoder import Landmarks as PlainLandmarks

data = st.data()
CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25, 0.05)


@pytest.mark.parametrize("count", [1, 2, 40, 150])
@pytest.mark.parametrize("by_rows", [True, False])
def test_a_second_decoder_reads_landmarks(some: SimpleNamespace, count: int, by_rows: bool):
    one: Landmarks = some.node(count).landmarks
    if by_rows:
        one, _ = settle(one, CAMERA)
    plain = PlainLandmarks(pack_landmarks(one, CAMERA))
    assert (plain.version, plain.count) == (1, count)
    assert plain.flags == 2 + (by_rows or count == 1 or (one.pixels[1, 1] >= one.pixels[0, 1] and count == 2))
    back = unpack_landmarks(pack_landmarks(one, CAMERA), CAMERA)
    for n, (x, y, code, depth, sigma) in enumerate(plain.read(320, 240)):
        assert code == one.codes[n].tolist()
        assert (x, y) == tuple(back.pixels[n])
        assert (x, y) == pytest.approx(one.pixels[n], abs=1 / 16)
        assert depth == pytest.approx(back.depths[n], rel=1e-6, nan_ok=True)
        assert sigma == pytest.approx(back.depth_sigmas[n], rel=1e-6, nan_ok=True)


@given(data)
def test_landmarks_come_back_in_their_order(some: SimpleNamespace, data: st.DataObject):
    camera = data.draw(some.cameras)
    one: Landmarks = data.draw(some.landmarks(camera))
    if data.draw(st.booleans()):
        one, _ = settle(one, camera)
    packed = pack_landmarks(one, camera)
    back = unpack_landmarks(packed, camera)
    assert np.array_equal(back.codes, one.codes)
    assert back.codes.flags.writeable
    assert np.abs(back.pixels - one.pixels).max(initial=0) <= 1 / 16
    assert pack_landmarks(back, camera) == packed
    pixels, codes = unpack_features(pack_features(one.pixels, one.codes, camera), camera)
    assert np.array_equal(pixels, back.pixels)
    assert np.array_equal(codes, one.codes)


@given(data)
def test_settled_landmarks_come_back_to_the_last_bit(some: SimpleNamespace, data: st.DataObject):
    """The robot that made a node works with the same numbers as all receivers."""
    camera = data.draw(some.cameras)
    one, _ = settle(data.draw(some.landmarks(camera)), camera)
    back = unpack_landmarks(pack_landmarks(one, camera), camera)
    for name in ("pixels", "codes", "depths", "depth_sigmas"):
        assert getattr(back, name).tobytes() == getattr(one, name).tobytes()


FRAMING = 80
"""What the transport adds to a change: its key and two numbers."""


@pytest.mark.parametrize("photograph", ["coins", "page", "retina", "stereo_motorcycle"])
@pytest.mark.parametrize("most", first_quick([800, 3000, 1500, 4500], 2))
def test_a_node_of_a_photograph_keeps_its_byte_budget(photograph: str, most: int):
    """Real descriptors of images that no table was trained on; what is chosen fits, and little is wasted."""
    image = getattr(skimage.data, photograph)()
    image = image[0] if isinstance(image, tuple) else image
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    grey = cv2.resize(grey, (640, 480), interpolation=cv2.INTER_AREA)
    keypoints, sift = cv2.SIFT_create(nfeatures=300, contrastThreshold=0.005).detectAndCompute(grey, None)
    random, count = np.random.default_rng(0), len(sift)
    assert count >= 250
    depths = np.exp(random.normal(math.log(2.0), 0.6, count)).astype(np.float32)
    sigmas = (depths * random.uniform(0.02, 0.1, count)).astype(np.float32)
    pixels = np.array([k.pt for k in keypoints], np.float32)
    camera = Camera(640, 480, 554.0, 554.0, 319.5, 239.5, 0.25, 0.05)
    every = Landmarks(pixels, encode(sift), depths, sigmas)
    kept = choose(every, np.ones(count), camera, SelectionSettings(most))
    landmarks, _ = settle(every.take(kept), camera)
    here = PoseGaussian.from_sigmas(Pose2(1.2345, -2.0, 0.3), 0.02, 0.01)
    ranges = Ranges(random.uniform(-3, 3, 16), np.full(16, 2.0), 3.0)
    node_id = NodeId("a-robot-of-some-fleet", 2, 1234)
    node = Node(node_id, 1_700_000_000_000_000_000, here, camera, landmarks, "utc", 0.16, ranges)
    change = Change(node_id.map, 100_000, node.stamp_ns, NodePut(node))
    cost = len(encode_change(change)) + FRAMING
    assert 0.93 * most <= cost <= most
    if most == 3000:
        assert len(kept) >= 145


def test_order_by_rows_saves_its_rank(some: SimpleNamespace):
    """log2(150!) is 873 bits; the row of ones and zeros costs a little of that."""
    one: Landmarks = some.node(150).landmarks
    settled, _ = settle(one, CAMERA)
    saved = len(pack_landmarks(one, CAMERA)) - len(pack_landmarks(settled, CAMERA))
    assert 80 < saved < 110


def test_the_least_likely_is_not_longer_than_is_allowed():
    """Every symbol the rarest of its column, pixels as far apart as they can be."""
    tables, random = landmark_tables(), np.random.default_rng(0)
    large = Camera(16384, 16384, 1e4, 1e4, 8e3, 8e3, 0.3)
    pixels = random.uniform(-0.4, 1.4, (MAX_LANDMARKS, 2)) * 16384
    codes = np.tile(tables.codes.argmin(axis=1), (MAX_LANDMARKS, 1)).astype(np.uint8)
    depths = np.full(MAX_LANDMARKS, 9e3, np.float32)
    worst = Landmarks(pixels.astype(np.float32), codes, depths, np.zeros_like(depths))
    packed = pack_landmarks(worst, large)
    assert 0.9 * MAX_LANDMARKS_BYTES < len(packed) <= MAX_LANDMARKS_BYTES
    assert np.array_equal(unpack_landmarks(packed, large).codes, codes)


@settings(max_examples=100)
@given(data)
def test_damage_is_noticed(some: SimpleNamespace, data: st.DataObject):
    good = pack_landmarks(some.node(20).landmarks, CAMERA)
    bad = bytearray(good)
    bad[data.draw(st.integers(0, len(good) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(InvalidMessage, match="landmarks: ") as error:
        unpack_landmarks(bytes(bad), CAMERA)
    assert "\n" not in str(error.value)


def both_forms(packed: bytes) -> list[Landmarks | str]:
    """What comes of the compiled decoder, and of NumPy's; a reason if it is none."""
    collected: list[Landmarks | str] = []
    for form in (nullcontext, in_numpy):
        with form():
            try:
                collected.append(unpack_landmarks(packed, CAMERA))
            except InvalidMessage as error:
                collected.append(str(error))
    return collected


@settings(max_examples=100)
@given(data)
def test_forgeries_with_a_right_checksum_do_no_harm(some: SimpleNamespace, data: st.DataObject):
    """Every decoded value is finite, within the image's surroundings, and round-trips."""
    bad = bytearray(pack_landmarks(some.node(20).landmarks, CAMERA)[:-4])
    for _ in range(data.draw(st.integers(1, 3))):
        reach = data.draw(st.sampled_from([12, len(bad)]))
        bad[data.draw(st.integers(0, reach - 1))] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        bad = bad[: data.draw(st.integers(0, len(bad)))]
    forged = bytes(bad) + zlib.crc32(bad).to_bytes(4, "little")
    compiled, plain = both_forms(forged)
    if isinstance(compiled, str) or isinstance(plain, str):
        assert compiled == plain
        return
    one = compiled
    for name in ("pixels", "codes", "depths", "depth_sigmas"):
        assert getattr(one, name).tobytes() == getattr(plain, name).tobytes()
    assert np.isfinite(one.pixels).all()
    assert (one.depths[one.has_depth] > 0).all()
    packed = pack_landmarks(one, CAMERA)
    again = unpack_landmarks(packed, CAMERA)
    assert again.pixels.tobytes() == one.pixels.tobytes()
    assert pack_landmarks(again, CAMERA) == packed


def test_landmarks_are_no_features_and_features_no_landmarks(some: SimpleNamespace):
    one: Landmarks = some.node(5).landmarks
    with pytest.raises(InvalidMessage, match="flags"):
        unpack_features(pack_landmarks(one, CAMERA), CAMERA)
    with pytest.raises(InvalidMessage, match="flags"):
        unpack_landmarks(pack_features(one.pixels, one.codes, CAMERA), CAMERA)


def test_codes_that_are_none_are_refused(some: SimpleNamespace):
    one: Landmarks = some.node(5).landmarks
    wrong = one.codes.copy()
    wrong[2, 3] = 64
    for codes in (wrong, one.codes.astype(np.int64)):
        with pytest.raises(InvalidValue, match="uint8 below 64"):
            pack_landmarks(Landmarks(one.pixels, codes, one.depths, one.depth_sigmas), CAMERA)
