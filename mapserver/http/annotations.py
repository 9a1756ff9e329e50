"""Annotations over HTTP, as JSON."""

import time
from collections.abc import Mapping
from typing import Any

import msgspec

from mapweave.hybridmap.annotation import MAX_NAME
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import FloorPlan
from mapweave.hybridmap.named_nodes import noting
from mapweave.mapserver.annotation_words import annotation_of_words
from mapweave.mapserver.floor_plans import placed_plan
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.json_body import read_json
from mapweave.mapserver.http.json_values import json_values, time_of

EXAMPLES = {
    "name": '"kitchen"',
    "body": '{"kind": "place", "node": "r0.1.17"}',
    "removed": "true",
    "check": "true",
    "who": '"anna"',
    "because": '"wet paint"',
}
FORM = f'{{"name": {EXAMPLES["name"]}, "body": {EXAMPLES["body"]}}}'


class _Posted(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    body: dict[str, Any]
    removed: bool = False
    check: bool = False
    who: str = ""
    because: str = ""


def annotations_json(server: Answering) -> Mapping[str, Any]:
    """The whole record, and which of its entries hold now: each by the number of its place in the record."""
    record = server.annotations()
    holding = {id(record.last(entry.kind, entry.name)) for entry in record.made}
    values = json_values(record)["made"]
    return {
        "annotations": [
            {
                **value,
                "in_force": id(entry) in holding,
                "time": time_of(entry.stamp_ns),
                "words": entry.words,
            }
            for entry, value in zip(record.made, values, strict=True)
        ]
    }


def annotate(server: Answering, data: bytes, by: str, who: str = "") -> Mapping[str, Any]:
    """Add the annotation of a request.

    Args:
        server: keeps the record.
        data: JSON; the body's nodes may be words, see `body_of_words`.
        by: who says so, if the request does not tell.
        who: has logged in; then the request is not asked.

    Raises:
        InvalidValue: it is none, or says nothing new.
    """
    try:
        posted = read_json(data, _Posted, EXAMPLES)
    except InvalidValue as error:
        raise InvalidValue(f"{error}; send {FORM}") from None
    notes: list[str] = []
    annotation = annotation_of_words(
        posted.name[: MAX_NAME + 1], posted.body, posted.removed, server.annotations,
        noting(server.resolve, notes), server.plans, who or posted.who or by, posted.because, time.time_ns(),
    )  # fmt: skip
    said = "; ".join((server.annotate(annotation, posted.check), *notes))
    answer = {"said": said, "annotation": json_values(annotation)}
    if posted.check and not posted.removed and isinstance(annotation.body, FloorPlan):
        placed = placed_plan(annotation.name, annotation.body, server.merged())
        answer["plan"] = json_values(placed)
    return answer
