"""A hash of what a map says, whatever file it is in: the same map has the same hash.

Each item below becomes a line `SECTION DIGEST`, where DIGEST is the SHA-256 of its bytes in hexadecimal. The
lines are sorted, each ends with a line feed, and the hash is the SHA-256 of this text.

    change       the body (docs/wire.md) of each node and edge that is left when the changes are replayed,
                 links included; evidence in the order of its names, without the probability of a link
    refused      MessagePack [a, b, body of the refused edge, or nil]
    constraint   MessagePack [its number from 0, the constraint]: a later one may undo an earlier one
    annotation   MessagePack [its number from 0, the annotation]: likewise
    superseded   MessagePack [node, the node that replaces it]
    faded        MessagePack [node, the flags of its landmarks]
    retired      MessagePack [node, the number of the constraint that retires it]
    unlinked     MessagePack [map of which a server refused a change]

What follows from these is left out: poses and probabilities, which are computed again whenever a file is
read, and words for people (title, reasons, history).
"""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from msgspec import msgpack

from mapweave.hybridmap.change import ChangeBody, EdgePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.mapserver.own_maps import PROBABILITY
from mapweave.storage.map_file import MapFile
from mapweave.wire.codec import encode_body
from mapweave.wire.typed import packed


def content_hash(content: MapFile) -> str:
    """64 hexadecimal digits.

    Raises:
        InvalidValue: a node or edge cannot be encoded.
    """
    lines = sorted(f"{section} {hashlib.sha256(data).hexdigest()}\n" for section, data in _items(content))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _items(content: MapFile) -> Iterator[tuple[str, bytes]]:
    for body in HybridMap(content.changes).contents():
        yield "change", _body(body)
    for pair in content.refused:
        edge = None if pair.edge is None else _body(EdgePut(pair.edge))
        yield "refused", _packed([pair.a, pair.b, edge])
    for number, constraint in enumerate(content.constraints):
        yield "constraint", _packed([number, constraint])
    for number, annotation in enumerate(content.annotations):
        yield "annotation", _packed([number, annotation])
    for node, fate in content.superseded.items():
        yield "superseded", _packed([node, fate.by])
    for node, flags in content.faded.items():
        yield "faded", _packed([node, flags])
    for node, number in content.retired.items():
        yield "retired", _packed([node, number])
    for map_id in content.refused_changes:
        yield "unlinked", _packed([map_id])


def _packed(item: list[Any]) -> bytes:
    data: bytes = msgpack.encode(packed(item))
    return data


def _body(body: ChangeBody) -> bytes:
    if isinstance(body, EdgePut):
        evidence = {name: value for name, value in sorted(body.edge.evidence.items()) if name != PROBABILITY}
        body = EdgePut(replace(body.edge, evidence=evidence))
    return encode_body(body)
