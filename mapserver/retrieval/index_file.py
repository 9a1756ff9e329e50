"""The place index as a file, so that a restarted server need not insert every landmark again.

    line "mapweave places", header (JSON), means, blocks of landmarks ..., nodes, SHA-256 of all before

The parts are arrays in NumPy's format. The file is compared with
the store, node by node, by fingerprints of the descriptors (PlaceIndex.extend). A digest is at the end,
because undetected damage would put landmarks into cells where they are not found.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.landmark_tables import DIMENSIONS
from mapweave.hybridmap.landmark_tables import VERSION as TABLES
from mapweave.mapserver.log.entry import Position
from mapweave.mapserver.retrieval.coarse_quantizer import CoarseQuantizer
from mapweave.mapserver.retrieval.inverted_file import Block
from mapweave.mapserver.retrieval.landmark_index import LandmarkIndex
from mapweave.mapserver.retrieval.place_index import PlaceIndex, PlaceIndexSettings

MAGIC = b"mapweave places\n"
FORMAT = 1
READ_AT_ONCE = 1 << 22


Positions = Mapping[MapId, Position]


def save(path: Path, index: PlaceIndex, made_from: Positions) -> bool:
    """Write the file, or replace it at once when all is on the disk.

    Searches and new nodes wait for a block at a time, not for the file. Concurrent changes may be in it or
    not.

    Args:
        path: of the file; its folder must be there.
        index: may be in use.
        made_from: the logs behind it.

    Returns:
        Whether it was written: an index without cells is built as fast as it is read.

    Raises:
        InvalidFile: the disk does not take it.
    """
    means, blocks = index.landmarks.contents()
    if means is None:
        return False
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.name, delete=False) as file:
            try:
                _write(_Hashed(file), means, blocks, index, made_from)
                file.flush()
                os.fsync(file.fileno())
                Path(file.name).replace(path)
            except BaseException:
                Path(file.name).unlink(missing_ok=True)
                raise
    except OSError as error:
        raise InvalidFile(f"{path}: the place index cannot be saved ({error.strerror or error})") from None
    return True


def load(path: Path, logs: Positions, settings: PlaceIndexSettings | None = None) -> PlaceIndex:
    """Read the file.

    Args:
        path: of the file.
        logs: that the store holds now.
        settings: of the index.

    Returns:
        The index as it was, to be brought up to date from the store: `retain` what is there, `extend` by it.

    Raises:
        InvalidFile: there is none, it is damaged, or it was made from something else; with the reason.
    """
    try:
        with path.open("rb") as file:
            _check_digest(file, path)
            file.seek(len(MAGIC))
            return _read(file, path, logs, settings)
    except FileNotFoundError:
        raise InvalidFile(f"{path}: there is none yet") from None
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read ({error.strerror or error})") from None


class _Hashed:
    """Writes, and keeps the digest of what was written."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._digest = file, hashlib.sha256()

    def write(self, data: Any) -> int:
        self._digest.update(data)
        return self._file.write(data)

    def finish(self) -> None:
        self._file.write(self._digest.digest())


def _write(
    file: _Hashed, means: CoarseQuantizer, blocks: Iterator[Block], index: PlaceIndex, made_from: Positions
) -> None:
    file.write(MAGIC)
    # The nodes come last: a landmark whose node is gone by then has no owner, and is dropped when it is read.
    header = {
        "format": FORMAT, "tables": TABLES, "logs": [[*map_id, *at] for map_id, at in made_from.items()],
    }  # fmt: skip
    _put(file, np.frombuffer(json.dumps(header).encode(), np.uint8))
    for part in (means.heads, means.means, means.starts):
        _put(file, part)
    for block in blocks:
        if len(block.ids):
            _put(file, block.codes)
            _put(file, block.ids)
            _put(file, block.cells.astype(np.int32))
    _put(file, np.zeros((0, DIMENSIONS), np.uint8))
    slots = index.slots
    agents = sorted({node_id.agent for node_id in slots})
    number = {agent: k for k, agent in enumerate(agents)}
    table = [(number[node.agent], node.epoch, node.number, slot) for node, slot in slots.items()]
    _put(file, np.frombuffer(json.dumps(agents).encode(), np.uint8))
    _put(file, np.array(table, np.int64).reshape(-1, 4))
    file.finish()


def _read(file: IO[bytes], path: Path, logs: Positions, settings: PlaceIndexSettings | None) -> PlaceIndex:
    try:
        header = json.loads(_get(file).tobytes())
        if (header["format"], header["tables"]) != (FORMAT, TABLES):
            raise InvalidFile(f"{path}: of another version of this program")
        for agent, epoch, log_id, watermark in header["logs"]:
            now = logs.get(MapId(agent, epoch))
            if now is None or now.log_id != log_id or now.watermark < watermark:
                raise InvalidFile(f"{path}: made from a log of {agent}.{epoch} that the store does not have")
        means = _means(file)
        index = PlaceIndex(settings)
        landmarks = LandmarkIndex(index.settings.landmarks)
        landmarks.restore(means, _blocks(file, len(means)))
        agents = json.loads(_get(file).tobytes())
        rows = _get(file).tolist()
    except (ValueError, KeyError, TypeError, IndexError, EOFError) as error:
        raise InvalidFile(f"{path}: is no place index of this version ({error})") from None
    index.adopt({NodeId(agents[a], epoch, n): slot for a, epoch, n, slot in rows}, landmarks)
    return index


def _means(file: IO[bytes]) -> CoarseQuantizer:
    heads, means, starts = _get(file), _get(file), _get(file)
    ends = starts[0] == 0 and starts[-1] == len(means) and (np.diff(starts) > 0).all()
    shapes = (heads.shape, means.shape[1:]) == ((len(starts) - 1, DIMENSIONS), (DIMENSIONS,))
    if not (ends and shapes and heads.dtype == means.dtype == np.float32 and starts.dtype == np.int64):
        raise ValueError("its means do not belong together")
    return CoarseQuantizer(heads, means, starts)


def _blocks(file: IO[bytes], means: int) -> Iterator[Block]:
    # The C++ code that takes these does not check them.
    while len(codes := _get(file)):
        block = Block(codes, _get(file), _get(file).astype(np.int64))
        shapes = (codes.shape, block.ids.shape, block.cells.shape)
        n = len(codes)
        if shapes != ((n, DIMENSIONS), (n,), (n,)) or codes.dtype != np.uint8 or block.ids.dtype != np.int64:
            raise ValueError("its landmarks do not belong together")
        if block.ids.min() < 0 or block.cells.min() < 0 or block.cells.max() >= means:
            raise ValueError("its landmarks lie in no cell")
        yield block


def _put(file: Any, part: NDArray[Any]) -> None:
    np.lib.format.write_array(file, np.ascontiguousarray(part), allow_pickle=False)


def _get(file: IO[bytes]) -> NDArray[Any]:
    part: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return part


def _check_digest(file: IO[bytes], path: Path) -> None:
    """Read all of it once before any of it is used."""
    digest, size = hashlib.sha256(), os.fstat(file.fileno()).st_size
    left = size - digest.digest_size
    if left < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
        raise InvalidFile(f"{path}: is no place index")
    file.seek(0)
    while left > 0:
        data = file.read(min(READ_AT_ONCE, left))
        if not data:
            break
        digest.update(data)
        left -= len(data)
    if file.read() != digest.digest():
        raise InvalidFile(f"{path}: is damaged or cut off")
