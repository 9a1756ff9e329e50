"""The restart record as a file (see mapweave.mapserver.checksummed_file), so that a restarted server
supersedes the nodes that it had superseded.

header (JSON), the record as a message (see mapweave.wire.typed)
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.mapserver.checksummed_file import FileKind
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.wire.packing import Limit, pack
from mapweave.wire.typed import decode
from mapweave.wire.typed import packed as plain

MAGIC = b"mapweave superseded\n"
FORMAT = 3
LIMIT = Limit("record", 2**31, 2**28)
"""Of a million nodes 90 MB and 30 million values."""


def _parts(record: RestartRecord) -> Iterator[NDArray[Any]]:
    yield np.frombuffer(pack(plain(record)), np.uint8)


def _read(parts: Iterator[NDArray[Any]]) -> RestartRecord:
    record = decode(next(parts).tobytes(), RestartRecord, LIMIT)
    superseded, log = record.superseded, record.log
    if any(s.by in superseded or not record.judged >= {n, s.by} for n, s in superseded.items()):
        raise InvalidValue("a node is superseded by one that is not active")
    pairs = [*record.linked, *record.recent.overlaps]
    pairs += [pair for step in log.steps for pair in (*step.linked, *step.cut)]
    if not all(a < b for a, b in pairs):
        raise InvalidValue("a pair is not in the order of ids")
    parts_joined = (*log.joined, *(part for step in log.steps for part in step.parted))
    if any(not -1 <= step <= len(log.steps) for part in parts_joined for step in part.values()):
        raise InvalidValue("a step is out of range")
    return record


FILE = FileKind(MAGIC, {"format": FORMAT}, _parts, _read, "is no record of this version")
save, packed, load = FILE.save, FILE.packed, FILE.load
