"""Bags that were cut off or damaged: what stands before the damage, read record by record without an index.

So is an MCAP that does not say that its messages are of ROS 2, which `rosbags` refuses: they are of ROS 1, as
`mcap convert` makes it of a bag, or its recorder says nothing.

MCAP by its specification (https://mcap.dev/spec), ROS 1 by http://wiki.ros.org/Bags/Format/2.0, and the
SQLite files of ROS 2 by their rows in the order in which they were written.
"""

import io
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from mapweave.agent.recordings.bounded_decompression import MOST_BYTES, limit_rosbags
from mapweave.agent.ros_messages.values import TF_TYPE
from mapweave.hybridmap.errors import DeviceError

Item = tuple[int, str, str] | tuple[int, int, bytes]
"""A connection (its number, topic, type) or a message (of which connection, stamp in ns, bytes)."""
Items = Generator[Item, None, bool]
"""It returns whether the data is read to its end; of MCAP alone."""
ROS1, ROS2 = "ros1", "ros2"
"""Profiles of MCAP."""
MCAP_MAGIC, ROS1_MAGIC = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
MCAP_HEADER, MCAP_SCHEMA, MCAP_CHANNEL = 0x01, 0x03, 0x04
MCAP_MESSAGE, MCAP_CHUNK, MCAP_DATA_END = 0x05, 0x06, 0x0F
"""Opcodes of records, by the specification of MCAP."""
ROS1_MESSAGE, ROS1_CHUNK, ROS1_CONNECTION = 0x02, 0x05, 0x07
"""The field `op` of records, by the specification of ROS bags 2.0."""


@cache
def standard_messages(ros1: bool) -> Any:
    """The messages as ROS 1 or ROS 2 defines them; a type is compiled once, when it is first read."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from mapweave.wire.ros2.messages import typestore

    if not ros1:
        return typestore()
    store = get_typestore(Stores.ROS1_NOETIC)
    # The one type that is read here and missing in this store.
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPE))
    return store


def full_type(kind: str) -> str:
    """A type as ROS 2 names it, also in a .db3 of a recorder before ROS 2 Dashing: without /msg/."""
    package, _, name = kind.rpartition("/")
    return kind if "/" in package or not package else f"{package}/msg/{name}"


class DamagedBag:
    """One file of a bag, as far as it can be read.

    Attributes:
        topics: by name: the type of its messages, and how many there are.
        span_ns: when the first message and the last were recorded.
        loss: of an MCAP that is not said to be of ROS 2, what is wrong with it; empty if nothing is. None of
            others: `rosbags` says why it cannot read them.
    """

    def __init__(self, path: Path) -> None:
        """Read the file once, to see what is in it.

        Raises:
            DeviceError: there is no message in it.
        """
        self._path = path
        self._items, profile = _format_of(path)
        ros1 = profile == ROS1
        store = standard_messages(ros1)
        self._decode: Callable[[bytes, str], Any] = store.deserialize_ros1 if ros1 else store.deserialize_cdr
        topics: dict[int, tuple[str, str]] = {}
        counts: Counter[int] = Counter()
        times: list[int] = []
        self._at_end = False
        for connection, second, third in self._noting_end(path):
            if isinstance(second, str):
                topics[connection] = second, str(third)
            else:
                counts[connection] += 1
                # A row of a database that was cut off has no stamp.
                times += [second] if isinstance(second, int) else []
        self.topics = {topics[k][0]: (topics[k][1], count) for k, count in counts.items() if k in topics}
        if not self.topics:
            raise DeviceError(f"{path}: no message in it can be read")
        self.span_ns = (min(times), max(times)) if times else ()
        self.loss: str | None = None
        if self._items is _mcap and profile != ROS2:
            self.loss = (
                "" if self._at_end and _ends_as_mcap(path) else "a part is damaged, or its end is missing"
            )

    def _noting_end(self, path: Path) -> Iterator[Item]:
        self._at_end = bool((yield from self._items(path)))

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Stamps, ns, and messages of a topic, in the order in which they were recorded.

        Raises:
            Exception: whatever a message that cannot be decoded leads to.
        """
        kinds: dict[int, str] = {}
        for connection, second, third in self._items(self._path):
            if isinstance(second, str):
                if second == topic:
                    kinds[connection] = str(third)
            elif connection in kinds:
                assert isinstance(third, bytes)
                yield second, self._decode(third, kinds[connection])


def _format_of(path: Path) -> tuple[Callable[[Path], Items], str]:
    """How a file is read, and what its messages are of, as MCAP names it."""
    with path.open("rb") as file:
        begin = file.read(64)
    if begin.startswith(MCAP_MAGIC):
        return _mcap, _profile(begin[len(MCAP_MAGIC) :])
    if begin.startswith(ROS1_MAGIC):
        return _ros1, ROS1
    if begin.startswith(b"SQLite format 3"):
        return _sqlite, ROS2
    raise DeviceError(f"{path}: does not begin as a bag does")


def _profile(record: bytes) -> str:
    """What an MCAP's first record says that its messages are; empty if it does not."""
    try:
        return _text(record, 9)[0] if record[0] == MCAP_HEADER else ""
    except (IndexError, struct.error, UnicodeDecodeError):
        return ""


def _ends_as_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-len(MCAP_MAGIC), io.SEEK_END)
        return file.read() == MCAP_MAGIC


def _mcap(path: Path) -> Items:
    from rosbags.rosbag2.storage_mcap import decompress

    limit_rosbags()
    with path.open("rb") as file:
        file.seek(len(MCAP_MAGIC))
        schemas: dict[int, str] = {}
        return (yield from _mcap_records(file, schemas, decompress))


def _mcap_records(file: BinaryIO, schemas: dict[int, str], decompress: Callable[..., bytes] | None) -> Items:
    """The items of a file, or, without `decompress`, of a chunk: there are no chunks in chunks."""
    good = True
    while len(head := file.read(9)) == 9 and head[0] != MCAP_DATA_END:
        (size,) = struct.unpack("<Q", head[1:])
        content = _read(file, size)
        whole = len(content) == size
        try:
            if head[0] == MCAP_CHUNK:
                if decompress is None:
                    return False
                good &= yield from _mcap_records(_mcap_chunk(content, whole, decompress), schemas, None)
            elif whole and head[0] == MCAP_SCHEMA:
                schemas[struct.unpack_from("<H", content)[0]] = _text(content, 2)[0]
            elif whole and head[0] == MCAP_CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                yield number, _text(content, 4)[0], full_type(schemas.get(schema, ""))
            elif whole and head[0] == MCAP_MESSAGE:
                number, _, stamp, _ = struct.unpack_from("<HIQQ", content)
                yield number, stamp, content[22:]
        except Exception:  # noqa: BLE001  # what is damaged cannot be parsed: everything before it counts
            return False
        if not whole:
            return False
    return good and len(head) == (0 if decompress is None else 9)


def _mcap_chunk(content: bytes, whole: bool, decompress: Callable[..., bytes]) -> BinaryIO:
    _, _, size, crc = struct.unpack_from("<QQQI", content)
    compression, at = _text(content, 28)
    records = content[at + 8 :]
    if not whole and not compression:
        # What was written of a chunk that is not compressed can be read.
        return io.BytesIO(records)
    (length,) = struct.unpack_from("<Q", content, at)
    return io.BytesIO(decompress(records[:length], compression, size, crc))


def _text(content: bytes, at: int) -> tuple[str, int]:
    """A string with its length before it, and where it ends."""
    (length,) = struct.unpack_from("<I", content, at)
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length


def _ros1(path: Path) -> Items:
    from rosbags.rosbag1.reader import decompressors

    limit_rosbags()
    with path.open("rb") as file:
        file.seek(len(ROS1_MAGIC))
        yield from _ros1_records(file, decompressors)
    return False


def _ros1_records(file: BinaryIO, decompressors: Any) -> Iterator[Item]:
    """The items of a file, or, without `decompressors`, of a chunk."""
    while len(length := file.read(4)) == 4:
        try:
            fields = _ros1_fields(_read(file, struct.unpack("<I", length)[0]))
            (size,) = struct.unpack("<I", file.read(4))
            content = _read(file, size)
            whole, kind = len(content) == size, fields[b"op"][0]
            if kind == ROS1_CHUNK:
                if decompressors is None:
                    return
                compression = fields[b"compression"].decode()
                if whole or compression == "none":
                    inside = decompressors[compression](content) if whole else content
                    yield from _ros1_records(io.BytesIO(inside), None)
            elif whole and kind == ROS1_CONNECTION:
                name = _ros1_fields(content)[b"type"].decode().replace("/", "/msg/")
                yield struct.unpack("<I", fields[b"conn"])[0], fields[b"topic"].decode(), name
            elif whole and kind == ROS1_MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                yield struct.unpack("<I", fields[b"conn"])[0], seconds * 10**9 + nanoseconds, content
        except Exception:  # noqa: BLE001  # as above
            return
        if not whole:
            return


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name] = value
        at += 4 + length
    return fields


def _sqlite(path: Path) -> Items:
    file = sqlite3.connect(f"file:{path.resolve()}?mode=ro", uri=True)
    try:
        # Without this SQLite refuses a file that is shorter than its header says.
        file.execute("PRAGMA writable_schema = ON")
        for number, name, kind in file.execute("SELECT id, name, type FROM topics"):
            # What stood on a page that was cut off is NULL.
            if isinstance(name, str) and isinstance(kind, str):
                yield number, name, full_type(kind)
        last: Item | None = None
        for row in file.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY rowid"):
            if last is not None:
                yield last
            last = row
        # Not reached after an error: SQLite fills up with zeros the page in which the file was cut off.
        if last is not None:
            yield last
    except sqlite3.Error:
        pass
    finally:
        file.close()
    return False


def _read(file: BinaryIO, size: int) -> bytes:
    # A damaged length would otherwise ask for all memory there is.
    return file.read(min(size, MOST_BYTES))
