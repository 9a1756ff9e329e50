"""Decompression of parts of bags with a limit: `rosbags` unpacks whatever a chunk unpacks to.

A file of 6 kB, packed by bzip2, unpacked to 3 GB, and took 70 s.
"""

import bz2
import io
import os
from collections.abc import Callable
from functools import cache
from typing import Any, BinaryIO, cast

MOST_BYTES = 1 << 28
"""Of one record, as it is read and as it is unpacked. Recorders write chunks of about 1 to 4 MiB."""
MOST_RATIO = 100
"""A file that is packed as a whole may unpack to this many times its size, and `MOST_BYTES` more. Raw images
pack 2 to 10 times; zeros pack 1200 times."""


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
    """The module `zstd` with a limit for single messages, and for files that are packed as a whole."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def decompress(self, data: bytes) -> bytes:
        return bounded(self._module.ZstdDecompressor, data)

    def open(self, file: BinaryIO, mode: str) -> BinaryIO:
        if mode != "rb":
            return cast(BinaryIO, self._module.open(file, mode))
        return io.BufferedReader(_BoundedFile(self._module.open(file, mode), os.fstat(file.fileno()).st_size))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _BoundedFile(io.RawIOBase):
    """A file that is unpacked while it is read: `rosbags` writes it to the disk, where robots keep maps."""

    def __init__(self, unpacked: BinaryIO, packed: int) -> None:
        """Begin.

        Args:
            unpacked: what is read.
            packed: size of the file, bytes.
        """
        self._unpacked = unpacked
        self._most = self._left = MOST_BYTES + MOST_RATIO * packed

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        part = self._unpacked.read(len(buffer))
        self._left -= len(part)
        if self._left < 0:
            raise ValueError(f"a file is larger than {self._most >> 20} MiB when it is unpacked")
        buffer[: len(part)] = part
        return len(part)

    def close(self) -> None:
        self._unpacked.close()
        super().close()
