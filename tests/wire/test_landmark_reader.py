"""The compiled reader of landmarks against the one in NumPy and against plain Python: numbers and reasons."""

import zlib
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.jit import load
from mapweave.hybridmap.node import Landmarks
from mapweave.hybridmap.quantization import settle
from mapweave.wire import landmark_reader
from mapweave.wire.landmark_codec import (
    HEAD,
    pack_features,
    pack_landmarks,
    unpack_features,
    unpack_landmarks,
)
from mapweave.wire.landmark_reader import read_in_numpy, read_landmarks
from tests.wire.plain_decoder import Landmarks as PlainLandmarks

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25, 0.05)


@pytest.fixture(autouse=True, scope="module")
def compiled() -> None:
    pytest.importorskip("numba")
    load()
    assert read_landmarks.machine is not read_in_numpy


def with_checksum(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(4, "little")


def outcome(packed: bytes, camera: Camera, form: Callable[..., int]) -> list[bytes] | str:
    """What comes of it, to the last bit; or why it is refused."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(landmark_reader, "read_landmarks", form)
        try:
            if packed[1] & 2:
                read = unpack_landmarks(packed, camera)
                return [a.tobytes() for a in (read.pixels, read.codes, read.depths, read.depth_sigmas)]
            return [a.tobytes() for a in unpack_features(packed, camera)]
        except InvalidMessage as error:
            return str(error)


def same_outcome(packed: bytes, camera: Camera) -> list[bytes] | str:
    compiled = outcome(packed, camera, read_landmarks.machine)
    assert compiled == outcome(packed, camera, read_in_numpy)
    return compiled


@st.composite
def packed_landmarks(draw: st.DrawFn, some: SimpleNamespace) -> tuple[bytes, Camera]:
    """Of any camera; with or without depths, by rows or not."""
    camera = draw(some.cameras)
    one: Landmarks = draw(some.landmarks(camera))
    if draw(st.booleans()):
        one, _ = settle(one, camera)
    if draw(st.booleans()):
        return pack_landmarks(one, camera), camera
    return pack_features(one.pixels, one.codes, camera), camera


@given(st.data())
def test_good_bytes_are_read_alike(some: SimpleNamespace, data: st.DataObject):
    packed, camera = data.draw(packed_landmarks(some))
    assert not isinstance(same_outcome(packed, camera), str)
    plain = PlainLandmarks(packed).read(camera.width, camera.height)
    codes = unpack_landmarks(packed, camera).codes if packed[1] & 2 else unpack_features(packed, camera)[1]
    assert [row[2] for row in plain] == codes.tolist()


@pytest.mark.slow
@settings(max_examples=400)
@given(st.data())
def test_bad_bytes_are_refused_alike(some: SimpleNamespace, data: st.DataObject):
    """Changed, cut off or too long, with a right checksum; what is read all the same is read alike."""
    packed, camera = data.draw(packed_landmarks(some))
    bad = bytearray(packed[:-4])
    for _ in range(data.draw(st.integers(0, 3))):
        # Most bytes are descriptors, which may be anything: aim at the head, and at the rows, as often.
        reach = data.draw(st.sampled_from([HEAD.size, min(40, len(bad)), len(bad)]))
        bad[data.draw(st.integers(2, reach - 1))] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        bad = bad[: data.draw(st.integers(HEAD.size, len(bad)))]
    bad += data.draw(st.binary(max_size=2))
    same_outcome(with_checksum(bytes(bad)), camera)


@pytest.mark.parametrize("count", [0, 1, 40])
@pytest.mark.parametrize("by_rows", [True, False])
def test_every_cut_is_refused_alike(some: SimpleNamespace, count: int, by_rows: bool):
    one: Landmarks = some.node(count).landmarks
    packed = pack_landmarks(settle(one, CAMERA)[0] if by_rows else one, CAMERA)[:-4]
    for length in range(HEAD.size, len(packed)):
        assert same_outcome(with_checksum(packed[:length]), CAMERA) in (
            "landmarks: cut off", f"landmarks: the rows are not those of {count} landmarks",
        )  # fmt: skip
    assert same_outcome(with_checksum(packed + b"\0"), CAMERA) == "landmarks: more than there should be"


def test_each_reason_is_given_by_both(some: SimpleNamespace):
    one, _ = settle(some.node(40).landmarks, CAMERA)
    packed = pack_landmarks(one, CAMERA)[:-4]
    head = HEAD.unpack_from(packed)
    rows = bytearray(packed)
    rows[HEAD.size] ^= 0x80
    wide = HEAD.pack(*head[:3], 65535, *head[4:]) + packed[HEAD.size :]
    high = HEAD.pack(*head[:5], 65535, head[6]) + packed[HEAD.size :]
    filled = [pack_landmarks(some.node(count).landmarks, CAMERA)[:-4] for count in range(1, 20)]
    said = [same_outcome(with_checksum(one[:-1] + bytes([one[-1] ^ 1])), CAMERA) for one in filled]
    assert "landmarks: more than there should be" in said, "where the last byte is not all used"
    assert same_outcome(with_checksum(bytes(rows)), CAMERA) == (
        "landmarks: the rows are not those of 40 landmarks"
    )
    for off in (wide, high):
        assert same_outcome(with_checksum(off), CAMERA) == "landmarks: a pixel is out of range"


def test_nothing_is_compiled_for_a_message(some: SimpleNamespace):
    """Whatever comes has the types that the reader is compiled for beforehand."""
    for count in (0, 1, 150):
        one: Landmarks = some.node(count).landmarks
        unpack_landmarks(pack_landmarks(one, CAMERA), CAMERA)
        unpack_features(pack_features(one.pixels, one.codes, CAMERA), CAMERA)
    signatures = read_landmarks.machine.signatures  # type: ignore[attr-defined]
    assert len(signatures) == 1
