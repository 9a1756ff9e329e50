"""Landmarks as packed bytes: nearly all of a map's size. The layout is in docs/wire.md.

Whole numbers (mapweave.hybridmap.quantization, mapweave.hybridmap.descriptor) are packed without loss, each
for the bits that its frequency is worth. About 17.5 bytes a landmark: 13.3 for the descriptor, 1.7 for depth
and sigma, 2.3 for the pixel. Where y never falls, the order of the landmarks costs nothing: the high bits of
y are written as steps up (Elias 1974, Fano 1971). The low ones, and x, are what the lane of a landmark
begins with, so they cost what they hold.
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.landmark_tables import SYMBOLS, TOTAL_BITS, VERSION
from mapweave.hybridmap.limits import MAX_LANDMARKS
from mapweave.hybridmap.node import CODE_BYTES, Landmarks
from mapweave.hybridmap.quantization import (
    FINE_BITS,
    PixelGrid,
    QuantizedLandmarks,
    restore_landmarks,
    round_landmarks,
)
from mapweave.wire.landmark_reader import CELLS, SHARES, LandmarkHead, Numbers, landmark_columns, read
from mapweave.wire.rans import Ints, LaneWriter, pack_bits

HEAD = struct.Struct("<BBHHHHH")
"""Version, flags, count, least x, reach of x, least y, reach of y."""

CHECK_BYTES = 4
"""Of CRC-32."""
ASCENDING, WITH_DEPTHS = 1, 2
"""Flags: whether y never falls; whether there are depths."""

MOST_STEPS = 65535
"""Greatest coordinate of a pixel."""

MAX_LANDMARKS_BYTES = MAX_LANDMARKS * ((CODE_BYTES + 3) * TOTAL_BITS + 32) // 8 + HEAD.size + CHECK_BYTES
"""Nothing costs more than this, however unlikely its symbols."""


def pack_landmarks(landmarks: Landmarks, camera: Camera) -> bytes:
    """Encode landmarks, in their order. They are rounded, see mapweave.hybridmap.quantization.

    Raises:
        InvalidValue: too many, a code that is none, a pixel off the image, or a depth that is not positive or
            without sigma.
    """
    return _pack(round_landmarks(landmarks, camera), landmarks.codes, with_depths=True)


def unpack_landmarks(data: bytes, camera: Camera) -> Landmarks:
    """Decode landmarks.

    Raises:
        InvalidMessage: damaged, of another version, or views' features.
    """
    numbers = _unpack(data, with_depths=True)
    rounded = QuantizedLandmarks(numbers.x, numbers.y, numbers.share, numbers.depth)
    return restore_landmarks(rounded, numbers.codes, camera)


def pack_features(pixels: NDArray[np.float32], codes: NDArray[np.uint8], camera: Camera) -> bytes:
    """Encode features without depth, in their order.

    Raises:
        InvalidValue: too many, shapes that do not belong together, or a pixel off the image.
    """
    if pixels.shape != (len(pixels), 2) or codes.shape != (len(pixels), CODE_BYTES):
        raise InvalidValue(f"features: shapes {pixels.shape} and {codes.shape} do not belong together")
    nothing = np.zeros(len(pixels), np.int64)
    x, y = PixelGrid.of(camera).round(pixels)
    return _pack(QuantizedLandmarks(x, y, nothing, nothing), codes, with_depths=False)


def unpack_features(data: bytes, camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Decode features into (N, 2) px and (N, 32) codes.

    Raises:
        InvalidMessage: damaged, of another version, or landmarks.
    """
    numbers = _unpack(data, with_depths=False)
    return PixelGrid.of(camera).restore(numbers.x, numbers.y), numbers.codes


def _pack(rounded: QuantizedLandmarks, codes: NDArray[np.uint8], with_depths: bool) -> bytes:
    count = len(codes)
    if count > MAX_LANDMARKS:
        raise InvalidValue(f"{count} landmarks, at most {MAX_LANDMARKS} are allowed")
    if codes.dtype != np.uint8 or (codes >= SYMBOLS).any():
        raise InvalidValue(f"descriptors must be uint8 below {SYMBOLS}, not {codes.dtype}")
    least_x, least_y = (int(of.min()) if count else 0 for of in (rounded.x, rounded.y))
    x, y = rounded.x - least_x, rounded.y - least_y
    reach_x, reach_y = int(x.max(initial=0)), int(y.max(initial=0))
    ascending = bool((np.diff(y) >= 0).all())
    low = _low_bits(count, reach_y) if ascending else reach_y.bit_length()
    row = _row_of(y >> low, reach_y >> low) if ascending else np.zeros(0, np.int64)
    size = _lane_size(reach_x, low)
    lanes = LaneWriter((x << low | y & ((1 << low) - 1)) + (1 << size), size)
    if with_depths:
        _push_depths(lanes, rounded)
    lanes.push(codes.T, landmark_columns().part(0, SHARES))
    flags = ASCENDING * ascending + WITH_DEPTHS * with_depths
    head = HEAD.pack(VERSION, flags, count, least_x, reach_x, least_y, reach_y)
    rows = row, np.ones_like(row)
    numbers, widths = (np.concatenate(pair) for pair in zip(rows, lanes.finish(), strict=True))
    data = head + pack_bits(numbers, widths)
    return data + zlib.crc32(data).to_bytes(CHECK_BYTES, "little")


def _unpack(data: bytes, with_depths: bool) -> Numbers:
    if len(data) < HEAD.size + CHECK_BYTES:
        raise InvalidMessage(f"landmarks: {len(data)} bytes are too few")
    version, flags, count, least_x, reach_x, least_y, reach_y = HEAD.unpack_from(data)
    if version != VERSION:
        raise InvalidMessage(f"landmarks: version {version}, this program reads {VERSION}")
    body, check = data[:-CHECK_BYTES], data[-CHECK_BYTES:]
    if zlib.crc32(body).to_bytes(CHECK_BYTES, "little") != check:
        raise InvalidMessage("landmarks: damaged, the checksum is wrong")
    if flags & ~(ASCENDING | WITH_DEPTHS) or bool(flags & WITH_DEPTHS) != with_depths:
        raise InvalidMessage(f"landmarks: flags {flags} do not go with them")
    if count > MAX_LANDMARKS:
        raise InvalidMessage(f"{count} landmarks, at most {MAX_LANDMARKS} are allowed")
    ascending = bool(flags & ASCENDING)
    low = _low_bits(count, reach_y) if ascending else reach_y.bit_length()
    return read(
        body[HEAD.size :],
        LandmarkHead(
            count,
            _lane_size(reach_x, low),
            low,
            reach_y >> low if ascending else -1,
            int(with_depths),
            least_x,
            min(least_x + reach_x, MOST_STEPS),
            least_y,
            min(least_y + reach_y, MOST_STEPS),
        ),
    )


def _push_depths(lanes: LaneWriter, rounded: QuantizedLandmarks) -> None:
    columns = landmark_columns()
    with_depth = np.flatnonzero(rounded.share)
    fine = FINE_BITS[rounded.share[with_depth]]
    depth = rounded.depth[with_depth]
    lanes.push_plain(depth & ((1 << fine) - 1), fine, with_depth)
    lanes.push((depth >> fine).astype(np.uint8)[None], columns.part(CELLS, CELLS + 1), with_depth)
    lanes.push(rounded.share.astype(np.uint8)[None], columns.part(SHARES, CELLS))


def _low_bits(count: int, reach: int) -> int:
    """How many bits of each ascending number are written plainly: so that few are left to count in ones."""
    return max(0, ((reach + 1) // max(count, 1)).bit_length() - 1)


def _lane_size(reach_x: int, low: int) -> int:
    """Bits of a lane: of what it begins with, x and the low bits of y."""
    return max(TOTAL_BITS, (((reach_x + 1) << low) - 1).bit_length())


def _row_of(high: Ints, steps: int) -> Ints:
    """Elias and Fano's code of the high parts: a one for a number, a zero for a step up."""
    row = np.zeros(len(high) + steps if len(high) else 0, np.int64)
    row[high + np.arange(len(high))] = 1
    return row
