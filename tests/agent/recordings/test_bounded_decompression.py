"""What a bag unpacks to is limited, in every way in which a bag may be compressed."""

import bz2
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2 import reader as ros2_reader
from rosbags.typesys import Stores, get_typestore

from mapweave.agent.recordings import bounded_decompression
from mapweave.agent.recordings.bag import Bag
from mapweave.agent.recordings.bounded_decompression import bounded
from mapweave.agent.recordings.damaged_bag import DamagedBag
from mapweave.agent.recordings.video import video_images
from mapweave.hybridmap.errors import DeviceError

ZSTD: Any = vars(ros2_reader)["zstd"]
KIND, TOPIC = "std_msgs/msg/UInt8MultiArray", "/zeros"
ZEROS = 1 << 20
"""Of the message of a bag, bytes."""
TOO_SMALL = 1 << 18
"""Limit, bytes, at which a chunk with the message is too large."""
DECOMPRESSORS = {
    "bz2": bz2.BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor, "zstd": ZSTD.ZstdDecompressor,
}  # fmt: skip
PACKED: dict[str, Callable[[bytes], bytes]] = {
    "bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": ZSTD.compress,
}  # fmt: skip


@pytest.mark.parametrize("kind", DECOMPRESSORS)
def test_as_much_as_the_limit_is_unpacked_and_no_byte_more(kind: str, monkeypatch):
    monkeypatch.setattr(bounded_decompression, "MOST_BYTES", TOO_SMALL)
    whole = PACKED[kind](bytes(TOO_SMALL - 3)) + PACKED[kind](b"end")
    assert bounded(DECOMPRESSORS[kind], whole) == bytes(TOO_SMALL - 3) + b"end"
    with pytest.raises(ValueError, match="a chunk is larger than 0 MiB when it is unpacked"):
        bounded(DECOMPRESSORS[kind], whole + PACKED[kind](b"x"))
    with pytest.raises(ValueError, match="a chunk is cut off"):
        bounded(DECOMPRESSORS[kind], whole[:-6])


@pytest.mark.parametrize("kind", DECOMPRESSORS)
def test_what_is_too_large_is_not_unpacked_first(kind: str, monkeypatch):
    monkeypatch.setattr(bounded_decompression, "MOST_BYTES", TOO_SMALL)
    bomb = PACKED[kind](bytes(20 * ZEROS))
    asked: list[int] = []

    class Stream:
        """Notes how much it is to unpack at most."""

        def __init__(self) -> None:
            self._stream = DECOMPRESSORS[kind]()

        def decompress(self, data: bytes, most: int = -1) -> bytes:
            asked.append(most)
            return self._stream.decompress(data, most)

    with pytest.raises(ValueError, match="a chunk is larger"):
        bounded(Stream, bomb)
    assert asked == [TOO_SMALL + 1]


def ros1(path: Path, kind: Writer1.CompressionFormat) -> Path:
    writer = Writer1(path := path / "a.bag")
    writer.set_compression(kind)
    return written(writer, path, Stores.ROS1_NOETIC, "serialize_ros1")


def ros2(path: Path, plugin: StoragePlugin, mode: CompressionMode) -> Path:
    writer = Writer(path := path / "a", version=8, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    return written(writer, path, Stores.ROS2_HUMBLE, "serialize_cdr")


def written(writer: Any, path: Path, stores: Stores, serialize: str) -> Path:
    store = get_typestore(stores)
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    message = store.types[KIND](layout=layout, data=np.zeros(ZEROS, np.uint8))
    with writer:
        connection = writer.add_connection(TOPIC, KIND, typestore=store)
        writer.write(connection, 1, getattr(store, serialize)(message, KIND))
    return path


BAGS: dict[str, Callable[[Path], Path]] = {
    "bz2": lambda path: ros1(path, Writer1.CompressionFormat.BZ2),
    "lz4": lambda path: ros1(path, Writer1.CompressionFormat.LZ4),
    "mcap": lambda path: ros2(path, StoragePlugin.MCAP, CompressionMode.STORAGE),
    "messages": lambda path: ros2(path, StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
}


@pytest.mark.parametrize("kind", BAGS)
def test_a_message_that_is_too_large_unpacked_ends_its_topic(kind: str, tmp_path, monkeypatch):
    """A bag of 6 kB took 6.2 GB."""
    path = BAGS[kind](tmp_path)
    ((_, message),) = Bag(path).messages(TOPIC)
    assert len(message.data) == ZEROS
    monkeypatch.setattr(bounded_decompression, "MOST_BYTES", TOO_SMALL)
    opened = Bag(path)
    assert list(opened.messages(TOPIC)) == []
    assert opened.damage == [
        f"{path}: {TOPIC} ends after 0 messages (a chunk is larger than 0 MiB when it is unpacked)"
    ]


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_file_that_is_packed_as_a_whole_and_is_too_large_is_not_unpacked(
    plugin: StoragePlugin, tmp_path, monkeypatch
):
    """A bag of 86 kB filled 100 MB of the disk."""
    path = ros2(tmp_path, plugin, CompressionMode.FILE)
    ((_, message),) = Bag(path).messages(TOPIC)
    assert len(message.data) == ZEROS
    kept = tmp_path / "kept"
    kept.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(kept))
    monkeypatch.setattr(bounded_decompression, "MOST_BYTES", TOO_SMALL)
    with pytest.raises(DeviceError, match="a file is larger than 0 MiB when it is unpacked"):
        Bag(path)
    assert not list(kept.iterdir())
    monkeypatch.setattr(bounded_decompression, "MOST_RATIO", ZEROS)
    assert len(list(Bag(path).messages(TOPIC))) == 1


@pytest.mark.parametrize("kind", ["bz2", "lz4", "mcap"])
def test_a_damaged_bag_is_unpacked_with_the_limit(kind: str, tmp_path, monkeypatch):
    """It is read without its index, in another way than a whole one."""
    path = BAGS[kind](tmp_path)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-10])
    assert len(list(DamagedBag(file).messages(TOPIC))) == 1
    monkeypatch.setattr(bounded_decompression, "MOST_BYTES", TOO_SMALL)
    with pytest.raises(DeviceError, match="no message in it can be read"):
        DamagedBag(file)


def test_a_chunk_in_a_chunk_is_not_unpacked(tmp_path):
    """Formats have none; each level would take the limit again."""
    path = next(BAGS["mcap"](tmp_path).glob("*.mcap"))
    data = path.read_bytes()
    at = 8
    while data[at] != 0x06:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    chunk = data[at : at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")]
    length = len(chunk).to_bytes(8, "little")
    outer = bytes(16) + length + bytes(4) + bytes(4) + length + chunk
    path.write_bytes(data[:at] + chunk)
    assert DamagedBag(path).topics == {TOPIC: (KIND, 1)}
    path.write_bytes(data[:at] + b"\x06" + len(outer).to_bytes(8, "little") + outer)
    with pytest.raises(DeviceError, match="no message in it can be read"):
        DamagedBag(path)


def test_a_video_of_too_many_pixels_is_refused_before_a_frame_is_decoded(tmp_path, monkeypatch):
    """Three black frames of 16000x16000 px in 5 MB took 2.1 GB."""

    class Large:
        def get(self, what: int) -> float:
            return {cv2.CAP_PROP_FRAME_WIDTH: 16_000.0, cv2.CAP_PROP_FRAME_HEIGHT: 16_000.0}[what]

        def grab(self) -> bool:
            pytest.fail("it was decoded")

    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: Large())
    with pytest.raises(DeviceError, match=r"a\.avi: an image of 16000x16000 px is too large"):
        video_images(tmp_path / "a.avi")
