"""Manual constraints as JSON: what people post, and what it means.

    {"link": ["r0.1.17", "r1.1.5"], "pose": [1.0, 0.2, 90]}      two nodes see one place; `pose` only by hand
    {"unmerge": ["r0.1", "r1.1"]}                                two nodes or two maps
    {"retire": ["r0.1.17", "r0.1.18"]}                           nodes, or one map
    {"area": {"anchor": "r0.1.17", "corners": [[0, -1], [2, -1], [2, 1]]}}
    {"window": {"map": "r0.1", "begin": "2026-03-01T12:00", "end": "2026-03-01T12:05"}}
    {"undo": 3}                                                  takes back number 3 of the record

In the place of a node there may be the name of a place, or a position in the merged map; `retire` with the
name of an area retires the area. With each: `because`, `by`, `undo: true` (takes it back), `check: true`
(only says what it would do).
"""

from collections.abc import Sequence

import msgspec

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredArea,
    RetiredMap,
    Subject,
    read_ends,
    read_pose,
    read_retired,
    read_window,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint, to_take_back
from mapweave.hybridmap.named_nodes import Record, Resolve, own_ids_of, retired_of
from mapweave.mapserver.http.json_body import read_json

ONE = "link, unmerge, retire, area, window, or undo with a number"
EXAMPLES = {
    "link": '["r0.1.17", "r1.1.5"]',
    "pose": "[1.0, 0.2, 90]",
    "unmerge": '["r0.1", "r1.1"]',
    "retire": '["r0.1.17", "r0.1.18"]',
    "area": '{"anchor": "r0.1.17", "corners": [[0, -1], [2, -1], [2, 1]]}',
    "window": '{"map": "r0.1", "begin": "2026-03-01T12:00", "end": "2026-03-01T12:05"}',
    "undo": "3",
    "check": "true",
    "because": '"two like doors"',
    "by": '"anna"',
}
"""JSON by the name of a field."""


class _Area(msgspec.Struct, forbid_unknown_fields=True):
    anchor: str
    corners: list[tuple[float, float]]


class _Window(msgspec.Struct, forbid_unknown_fields=True):
    map: str
    begin: str | int = ""
    end: str | int = ""


class _Body(msgspec.Struct, forbid_unknown_fields=True):
    link: tuple[str, str] | None = None
    pose: tuple[float, float, float] | None = None
    unmerge: tuple[str, str] | None = None
    retire: list[str] | None = None
    area: _Area | None = None
    window: _Window | None = None
    undo: bool | int = False
    check: bool = False
    because: str = ""
    by: str = ""


def read_request(
    body: bytes,
    by: str,
    now_ns: int,
    record: Sequence[ManualConstraint],
    annotations: Record,
    resolve: Resolve,
) -> ConstraintRequest:
    """A manual constraint as it is posted.

    Args:
        body: JSON.
        by: has decided, if the request does not say.
        now_ns: wall time.
        record: the constraints that there are, in order.
        annotations: returns the record with the places.
        resolve: returns nodes for words.

    Raises:
        InvalidValue: it is no such request.
    """
    try:
        asked = read_json(body, _Body, EXAMPLES)
    except InvalidValue as error:
        raise InvalidValue(f"the body is no constraint: {error}; send {ONE}, as JSON") from None
    numbered = not isinstance(asked.undo, bool)
    given = [
        subject
        for subject in (asked.link, asked.unmerge, asked.retire, asked.area, asked.window)
        if subject is not None
    ]
    if len(given) + numbered != 1:
        raise InvalidValue(f"give one of {ONE}")
    about = to_take_back(record, asked.undo) if numbered else _subject(asked, now_ns, annotations, resolve)
    constraint = ManualConstraint(about, asked.undo is False, asked.by or by, now_ns, asked.because)
    return ConstraintRequest(constraint, asked.check)


def _subject(asked: _Body, now_ns: int, annotations: Record, resolve: Resolve) -> Subject:
    if asked.link is not None:
        a, b = map(NodeId.parse, own_ids_of(asked.link, annotations, resolve))
        return Linked(a, b, None if asked.pose is None else read_pose(asked.pose))
    if asked.unmerge is not None:
        return Apart(read_ends(*own_ids_of(asked.unmerge, annotations, resolve)))
    if asked.area is not None:
        (anchor,) = own_ids_of([asked.area.anchor], annotations, resolve)
        return RetiredArea(Area(NodeId.parse(anchor), tuple(asked.area.corners)))
    if asked.window is not None:
        which = read_retired([asked.window.map])
        if not isinstance(which, RetiredMap):
            raise InvalidValue(f"{asked.window.map} is no map")
        if asked.window.begin == asked.window.end == "" and asked.undo is False:
            # As a script sends it whose times are missing; what was kept so can be taken back.
            raise InvalidValue(
                f'a time window begins or ends: give "begin", "end" or both; {{"retire": ["{which.map}"]}} '
                "retires the whole map"
            )
        return read_window(which.map, asked.window.begin, asked.window.end, now_ns)
    return retired_of(asked.retire or (), annotations, resolve)
