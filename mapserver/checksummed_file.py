"""Files, and results of a store, of arrays with a digest at the end: read whole and undamaged, or not at all.

a line with its kind, arrays in NumPy's format ..., SHA-256 of all before
"""

import hashlib
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.storage.atomic_file import write_whole

Value = TypeVar("Value")

DIGEST = 32
"""Bytes of SHA-256."""
_UNFIT = ValueError, KeyError, TypeError, IndexError, EOFError, StopIteration
"""What reading raises where arrays are not those of a value."""


@dataclass(frozen=True)
class FileKind(Generic[Value]):
    """Values of one kind as such files.

    Attributes:
        magic: the first line.
        header: the format, and what else must be the same when it is read.
        parts: arrays of plain numbers, of a value.
        read: the value of the same arrays.
        lack: what a file is that has none, for example "is no map".
    """

    magic: bytes
    header: Mapping[str, Any]
    parts: Callable[[Value], Iterable[NDArray[Any]]]
    read: Callable[[Iterator[NDArray[Any]]], Value]
    lack: str

    def save(self, path: Path, value: Value, made_by: str) -> None:
        """Write a file, or replace it at once when all is on the disk.

        Args:
            path: of the file; its folder must be there.
            value: to be kept.
            made_by: settings and version of what made it, in words.

        Raises:
            InvalidFile: the disk does not take it.
        """
        write_whole(path, self.packed(value, made_by))

    def packed(self, value: Value, made_by: str) -> bytes:
        """The bytes of the file; see `save`."""
        return checksummed(self.magic, (json_part({**self.header, "made_by": made_by}), *self.parts(value)))

    def load(self, source: Path | bytes, made_by: str) -> Value:
        """Read a file.

        Args:
            source: the file, or its bytes.
            made_by: as it was saved; what other versions have made is not used.

        Raises:
            InvalidFile: there is none, it is damaged, or it was made otherwise; with the reason.
        """
        return read_checksummed(source, self.magic, {**self.header, "made_by": made_by}, self.read, self.lack)


def checksummed(magic: bytes, parts: Iterable[NDArray[Any]]) -> bytes:
    """The bytes of such a file.

    Args:
        magic: the first line.
        parts: arrays of plain numbers.
    """
    out = io.BytesIO()
    out.write(magic)
    for part in parts:
        np.lib.format.write_array(out, np.ascontiguousarray(part), allow_pickle=False)
    digest = hashlib.sha256(out.getbuffer()).digest()
    out.write(digest)
    # Not a view: Python 3.13 reports a stream that is collected in a cycle with one.
    return out.getvalue()


def unseal(source: Path | bytes, magic: bytes) -> Iterator[NDArray[Any]]:
    """The arrays of a file, or of its bytes, in their order.

    Raises:
        InvalidFile: there is none, it is another one, or it is damaged.
    """
    words = f"{source}: " if isinstance(source, Path) else ""
    try:
        data = source.read_bytes() if isinstance(source, Path) else source
    except FileNotFoundError:
        raise InvalidFile(f"{words}there is none yet") from None
    except OSError as error:
        raise InvalidFile(f"{words}cannot be read ({error.strerror or error})") from None
    if not data.startswith(magic):
        raise InvalidFile(f"{words}is something else")
    content = memoryview(data)[:-DIGEST]
    if len(data) < len(magic) + DIGEST or hashlib.sha256(content).digest() != data[-DIGEST:]:
        raise InvalidFile(f"{words}is damaged or cut off")
    return _arrays(io.BytesIO(content[len(magic) :]), len(content) - len(magic))


def read_checksummed(
    source: Path | bytes,
    magic: bytes,
    header: Any,
    read: Callable[[Iterator[NDArray[Any]]], Value],
    lack: str,
) -> Value:
    """What a file, or its bytes, have behind a header.

    Args:
        source: the file.
        magic: its first line.
        header: what `json_part` has made its first array of.
        read: makes the value of the other arrays.
        lack: what it is if they make none, for example "is no map".

    Raises:
        InvalidFile: there is none, it is damaged, it has another header, or it is no such value.
    """
    parts, words = unseal(source, magic), f"{source}: " if isinstance(source, Path) else ""
    try:
        if read_json(next(parts)) != header:
            raise InvalidFile(f"{words}of another version of this program, or with other settings")
        return read(parts)
    except (InvalidValue, InvalidMessage, *_UNFIT) as error:
        raise InvalidFile(f"{words}{lack} ({error})") from None


def json_part(words: Any) -> NDArray[np.uint8]:
    """Words as an array."""
    return np.frombuffer(json.dumps(words).encode(), np.uint8)


def read_json(part: NDArray[Any]) -> Any:
    """Such an array's words again."""
    return json.loads(part.tobytes())


def _arrays(file: io.BytesIO, size: int) -> Iterator[NDArray[Any]]:
    while file.tell() < size:
        try:
            part: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
        except Exception as error:  # noqa: BLE001 - of heads NumPy raises what its parsers do, and MemoryError
            raise ValueError(f"an array is none ({type(error).__name__})") from None
        yield part
