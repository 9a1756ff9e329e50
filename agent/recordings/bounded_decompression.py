"""Decompression of parts of bags with a limit: `rosbags` unpacks whatever a chunk unpacks to.

A file of 6 kB, packed by bzip2, unpacked to 3 GB, and took 70 s.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable
from functools import cache
from typing import Any

MOST_BYTES = 1 << 28
"""Of one record, as it is read and as it is unpacked. Recorders write chunks of about 1 to 4 MiB."""


def bounded(make: Callable[[], Any], data: bytes) -> bytes:
    """Decompress all streams of a part.

    Args:
        make: a decompressor of one stream, as `bz2.BZ2Decompressor`.
        data: the streams, one behind the other.

    Raises:
        ValueError: it is more than `MOST_BYTES`, or is cut off.
        Exception: whatever damage leads to.
    """
    parts, left = list[bytes](), MOST_BYTES
    while data:
        stream = make()
        part = stream.decompress(data, left + 1)
        left -= len(part)
        if left < 0:
            raise ValueError(f"a chunk is larger than {MOST_BYTES >> 20} MiB when it is unpacked")
        if not stream.eof:
            raise ValueError("a chunk is cut off")
        parts.append(part)
        data = stream.unused_data
    return b"".join(parts)


@cache
def limit_rosbags() -> None:
    """Let `rosbags` decompress with the limit, wherever it does: it has no setting for that."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    # From Python 3.14 on it is of the standard library.
    zstd: Any = vars(ros2)["zstd"]
    ros1.decompressors["bz2"] = lambda data: bounded(bz2.BZ2Decompressor, data)
    ros1.decompressors["lz4"] = lambda data: bounded(LZ4FrameDecompressor, data)
    mcap.DECOMPRESSORS["lz4"] = lambda data, _: bounded(LZ4FrameDecompressor, data)
    mcap.DECOMPRESSORS["zstd"] = lambda data, _: bounded(zstd.ZstdDecompressor, data)
    vars(ros2)["zstd"] = _BoundedZstd(zstd)


class _BoundedZstd:
    """The module `zstd` with a limit for single messages."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def decompress(self, data: bytes) -> bytes:
        return bounded(self._module.ZstdDecompressor, data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)
