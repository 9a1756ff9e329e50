"""Annotations in a person's words: places and positions where the record has nodes and polygons."""

from collections.abc import Callable, Mapping
from datetime import UTC
from typing import Any, TypeVar

import numpy as np

from mapweave.hybridmap.annotation import BODIES, Annotation, Annotations, Body, Place
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import PlacedPlan, PlacedPlans, PlanPart
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import MAX_POSITION
from mapweave.hybridmap.named_nodes import Resolve
from mapweave.hybridmap.query import Resolved, ResolveRequest
from mapweave.hybridmap.wall_time import read_time
from mapweave.mapserver.field_words import field_words
from mapweave.mapserver.places import others_of, position_of
from mapweave.mapserver.plan_answers import goal_on_plan, in_merged, near_part, part_near
from mapweave.wire.typed import packed, value_of

NODES = ("node", "anchor", "a", "b", "merged_from_node")
"""Fields that are nodes."""
ANYWHERE = 1e6
"""An area may lie away from all nodes, m: they only give its frame."""

TIMES = ("begin_ns", "end_ns")
EXAMPLES = {
    **dict.fromkeys(NODES[:4], '"r0.1.17"'),
    "merged_from_node": "[12.5, -3.0, 1.57]",
    "area": '{"anchor": "r0.1.17", "corners": [[0, -1], [2, -1], [2, 1]]}',
    "corners": "[[0, -1], [2, -1], [2, 1]]",
    "radius": "1.5",
    "edge": '["r0.1.17", "r0.1.19"]',
    **dict.fromkeys(TIMES, '"2026-03-01 14:00"'),
    "factor": "4",
    "label": '"first"',
    "means": '"lift", "ramp" or "door"',
    "note": '"key: desk"',
    "pairs": '[{"at": "r0.1.17", "u": 102, "v": 340}]',
    "metres_per_pixel": "0.05",
    "origin": "[0, 0, 0]",
}
"""JSON by the name of a field."""
AROUND = 1.0
"""Of a place that is a node, so much floor around it is meant, m."""

Value = TypeVar("Value")


def body_of_words(
    kind: str,
    fields: Mapping[str, Any],
    resolve: Resolve,
    annotations: Annotations,
    plans: Callable[[], PlacedPlans],
    now_ns: int,
) -> Body:
    """The body of an annotation.

    Args:
        kind: of the annotation: place, closure and so on.
        fields: those of the body as plain data. Times may be text, see mapweave.hybridmap.wall_time; without
            a zone they are UTC. In the place of a node there may be a word: a node
            (`r0.1.17`), the name of a place, a position in the merged map (`3.1,-2.0`). An area is `area`,
            or `corners`, a list of positions in the merged map (in the frame of the component of `near`, a
            node or place; of the largest component without), or `radius`, m, around `node`; or
            `place`, a named place. A pair of a plan has `at`, such a word, or `node` with `x` and `y`. A pin
            without `merged_from_node` holds its node where it is. With `plan`, the name of a floor plan,
            positions are on it, under the component of `near` or that with most of its pairs; a pin then
            gives its component the coordinates of the plan.
        resolve: returns nodes for words.
        annotations: the record.
        plans: returns the floor plans under the map.
        now_ns: the present time.

    Raises:
        InvalidValue: something is missing or wrong, with the reason.
    """
    if kind not in BODIES:
        raise InvalidValue(f"there are no annotations of kind {kind!r}: {', '.join(BODIES)}")
    plain = dict(fields)
    corners, radius, near = (plain.pop(name, None) for name in ("corners", "radius", "near"))
    if not isinstance(near, str | None):
        raise InvalidValue(f"`near` is a node or the name of a place, not {near!r:.40}")
    plan = plain.pop("plan", None) if kind != "plan" else None
    placed = None if plan is None else plans().plan(str(plan))
    if placed is not None and kind != "pin":
        part = part_near(placed, near or "", resolve)
        near = near or near_part(part)
        plain = {name: _off_plan(value, name, placed, part, resolve) for name, value in plain.items()}
        if corners is not None:
            corners = [in_merged(corner, part) for corner in _corners(corners)]
    for name in TIMES:
        if isinstance(plain.get(name), str):
            begin_ns = plain.get("begin_ns")
            begin_ns = begin_ns if name != "begin_ns" and isinstance(begin_ns, int) else 0
            plain[name] = read_time(plain[name], now_ns, UTC, begin_ns)
    if (place := plain.pop("place", None)) is not None:
        entry = annotations.last("place", str(place))
        if entry is None:
            raise not_there("place", str(place), annotations)
        if isinstance(entry.body, Place) and entry.body.area is not None:
            plain["area"], radius = packed(entry.body.area), None
        else:
            plain["node"], radius = str(place), AROUND if radius is None else radius
    if corners is not None:
        plain["area"] = packed(_area(corners, near or "", resolve))
    elif isinstance(area := plain.get("area"), Mapping):
        plain["area"] = {name: _node(value, name, near, resolve) for name, value in area.items()}
    elif radius is not None:
        node = value_of(_node(plain.pop("node", ()), "node", near, resolve), NodeId)
        plain["area"] = packed(Area.around(node, _value(radius, float, "radius")))
    if isinstance(edge := plain.get("edge"), list | tuple):
        plain["edge"] = [_node(word, "node", near, resolve) for word in edge]
    if isinstance(pairs := plain.get("pairs"), list | tuple):
        plain["pairs"] = [_pair(pair, near, resolve) for pair in pairs]
    if kind == "pin" and isinstance(word := plain.get("node"), str):
        if placed is not None and "merged_from_node" in plain:
            raise InvalidValue(f"plan {placed.name} says where {word} is on it: leave the pose out")
        if "merged_from_node" not in plain:
            found = _found(word, near or "", resolve)
            pose = found.merged_from_node
            if placed is not None:
                pose = placed.part(found.component).plan_from_merged @ pose
            plain["merged_from_node"] = packed(pose)
    body = {name: _node(value, name, near, resolve) for name, value in plain.items()}
    unknown = body.keys() - BODIES[kind].__dataclass_fields__.keys() - {"kind"}
    if "node" in unknown and "area" in BODIES[kind].__dataclass_fields__:
        raise InvalidValue(f"a {kind} has no `node` without `radius`, m, of the floor around it")
    if unknown:
        raise InvalidValue(f"a {kind} has no {', '.join(sorted(unknown))}")
    return _value(body, BODIES[kind])


def not_there(kind: str, name: str, annotations: Annotations) -> InvalidValue:
    """That no entry of this kind has this name, and which have one."""
    names = [entry.name for entry, _ in annotations.in_force(BODIES[kind])]
    return InvalidValue(f"there is no {kind} {name}{others_of(name, names)}")


def _value(plain: Any, kind: type[Value], within: str = "") -> Value:
    """A value of plain data; what is wrong with it is said in the words of who has sent it (InvalidValue)."""
    try:
        return value_of(plain, kind)
    except InvalidValue as error:
        raise InvalidValue(field_words(str(error), EXAMPLES, within)) from None


def _node(value: Any, name: str, near: str | None, resolve: Resolve) -> Any:
    """A word as a node; everything else as it is.

    Raises:
        InvalidValue: it is neither a word nor an id.
    """
    if name not in NODES or value is None:
        return value
    if not isinstance(value, str):
        if name == "merged_from_node":
            return value
        try:
            return packed(value_of(value, NodeId))
        except InvalidValue:
            raise InvalidValue(f"`{name}`: give a node as text, for example {EXAMPLES[name]}") from None
    return packed(_found(value, near or "", resolve).node)


def _found(word: str, near: str, resolve: Resolve, reach: float | None = None) -> Resolved:
    request = ResolveRequest((word,), near) if reach is None else ResolveRequest((word,), near, reach)
    return resolve(request).found[0]


def _pair(pair: Any, near: str | None, resolve: Resolve) -> Any:
    """A pair of a plan, its place as a node and a position from there."""
    if not isinstance(pair, Mapping):
        return pair
    plain = dict(pair)
    word = plain.pop("at", None)
    if not isinstance(word, str):
        return {name: _node(value, name, near, resolve) for name, value in plain.items()}
    found, position = _found(word, near or "", resolve, ANYWHERE), position_of(word)
    x, y = (0.0, 0.0)
    if position is not None:
        x, y = found.merged_from_node.inverse().apply(np.array(position)).tolist()
    return {**plain, "node": packed(found.node), "x": x, "y": y}


def _off_plan(value: Any, name: str, placed: PlacedPlan, part: PlanPart, resolve: Resolve) -> Any:
    """A field with nodes in the place of positions on a plan."""
    if name in NODES and isinstance(value, str):
        return goal_on_plan(value, placed, part.component, resolve)
    if name == "edge" and isinstance(value, list | tuple):
        return [_off_plan(word, "node", placed, part, resolve) for word in value]
    return value


def _corners(corners: Any) -> list[tuple[float, float]]:
    return _value(corners, list[tuple[float, float]], "corners")


def _area(corners: Any, near: str, resolve: Resolve) -> Area:
    points = _corners(corners)
    if not points:
        raise InvalidValue("an area has 3 corners or more")
    # Written so that NaN fails.
    if not all(abs(v) <= MAX_POSITION for corner in points for v in corner):
        raise InvalidValue(f"corners are at most {MAX_POSITION:g} m from the origin of the map")
    x, y = np.mean(points, axis=0)
    found = _found(f"{x:.3f},{y:.3f}", near, resolve, ANYWHERE)
    return Area.of_merged(found.node, found.merged_from_node, points)


def annotation_of_words(
    name: str,
    fields: Mapping[str, Any],
    removed: bool,
    annotations: Callable[[], Annotations],
    resolve: Resolve,
    plans: Callable[[], PlacedPlans],
    who: str,
    because: str,
    stamp_ns: int,
) -> Annotation:
    """An entry for the record.

    Args:
        name: of the annotation.
        fields: `kind`, and what the body has; see `body_of_words`. To withdraw an entry its kind is enough.
        removed: whether the entry of this name is withdrawn.
        annotations: returns the record.
        resolve: returns nodes for words.
        plans: returns the floor plans under the map.
        who: says so.
        because: why.
        stamp_ns: the present time.

    Raises:
        InvalidValue: something is missing or wrong, or there is nothing to withdraw.
    """
    kind = fields.get("kind")
    if not isinstance(kind, str) or kind not in BODIES:
        raise InvalidValue(f"an annotation has a kind: {', '.join(BODIES)}")
    if removed:
        before = annotations().last(kind, name)
        if before is None:
            raise not_there(kind, name, annotations())
        body = before.body
    else:
        body = body_of_words(kind, fields, resolve, annotations(), plans, stamp_ns)
    return Annotation(name, body, removed, who, stamp_ns, because)
