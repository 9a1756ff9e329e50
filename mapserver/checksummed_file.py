"""Files of arrays with a digest at the end: read whole and undamaged, or not at all.

a line with its kind, arrays in NumPy's format ..., SHA-256 of all before
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.atomic_file import write_whole

DIGEST = 32
"""Bytes of SHA-256."""


def seal(path: Path, magic: bytes, parts: Iterable[NDArray[Any]]) -> None:
    """Write the file, or replace it at once when all is on the disk.

    Args:
        path: of the file; its folder must be there.
        magic: the first line.
        parts: arrays of plain numbers.

    Raises:
        InvalidFile: the disk does not take it.
    """
    out = io.BytesIO()
    out.write(magic)
    for part in parts:
        np.lib.format.write_array(out, np.ascontiguousarray(part), allow_pickle=False)
    digest = hashlib.sha256(out.getbuffer()).digest()
    out.write(digest)
    write_whole(path, out.getbuffer())


def unseal(path: Path, magic: bytes) -> Iterator[NDArray[Any]]:
    """The arrays of a file, in their order.

    Raises:
        InvalidFile: there is none, it is another one, or it is damaged.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InvalidFile(f"{path}: there is none yet") from None
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read ({error.strerror or error})") from None
    if not data.startswith(magic):
        raise InvalidFile(f"{path}: is something else")
    content = memoryview(data)[:-DIGEST]
    if len(data) < len(magic) + DIGEST or hashlib.sha256(content).digest() != data[-DIGEST:]:
        raise InvalidFile(f"{path}: is damaged or cut off")
    return _arrays(io.BytesIO(content[len(magic) :]), len(content) - len(magic))


def _arrays(file: io.BytesIO, size: int) -> Iterator[NDArray[Any]]:
    while file.tell() < size:
        part: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
        yield part
