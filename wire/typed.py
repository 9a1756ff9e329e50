"""Conversion between values and plain data: dataclasses become maps of their fields, at any depth.

`packed` returns what MessagePack and JSON accept: numbers, text, bytes, lists and maps. `decode` returns the
value. `msgspec.convert` checks every type and range; a value checks what else it requires when it is created.

Some types have their own form, see docs/wire.md: poses are 36 bytes, a node is the body of its change, an
array is `[kind, shape, bytes]`, a map with ids or pairs of them as keys is a list of pairs. Where a value
may be one of several dataclasses (`A | B`), each has a `TAG`, which travels as the field `kind`.
"""

import math
from collections.abc import Callable, Mapping, Set
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache, reduce
from operator import or_
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.annotation import BODIES, MAX_ANNOTATIONS, Annotation
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Ends
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_FLOAT, Coordinate
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import Distortion, RadialTangential
from mapweave.wire.codec import decode_body, encode_body
from mapweave.wire.conversion import convert
from mapweave.wire.packing import Limit, pack, unpack
from mapweave.wire.pose_codec import pack_camera, pack_pose, unpack_camera, unpack_pose

Value = TypeVar("Value")
Packers = Mapping[type, Callable[[Any], Any]]
PLAIN = frozenset({NoneType, bool, int, str, bytes})
"""Types that plain data has as they are."""


class Form(NamedTuple):
    """How values of a type are read.

    Attributes:
        plain: type of the plain data.
        read: returns the value; raises InvalidMessage or InvalidValue.
    """

    plain: Any
    read: Callable[[Any], Any]


def _node(data: bytes) -> Node:
    body = decode_body(data)
    if not isinstance(body, NodePut):
        raise InvalidMessage("not a node")
    return body.node


def _edge(data: bytes) -> Edge:
    body = decode_body(data)
    if not isinstance(body, EdgePut):
        raise InvalidMessage("not an edge")
    return body.edge


def _ends(ends: tuple[list[Any], list[Any]]) -> Any:
    return tuple(_convert(end, NodeId if len(end) == 3 else MapId) for end in ends)


def _events(events: list[dict[str, Any]]) -> tuple[MapEvent, ...]:
    """Skips events of unknown kinds: a newer program may have written them."""
    kinds = set(MapEventKind)
    read = (event for event in events if not isinstance(event.get("kind"), str) or event["kind"] in kinds)
    return tuple(_convert(event, _schema(MapEvent)) for event in read)


def _annotations(entries: list[dict[str, Any]]) -> tuple[Annotation, ...]:
    """Skips annotations of unknown kinds: a newer program may have written them."""
    bodies = [entry.get("body") for entry in entries]
    newer = [
        isinstance(body, dict) and isinstance(body.get("kind"), str) and body["kind"] not in BODIES
        for body in bodies
    ]
    return tuple(
        _convert(entry, _schema(Annotation)) for entry, skip in zip(entries, newer, strict=True) if not skip
    )


def _distortion(plain: list[float] | dict[str, Any]) -> Distortion:
    return _convert(plain, _schema(Equidistant if isinstance(plain, dict) else RadialTangential))  # type: ignore[no-any-return]


FORMS: dict[Any, Form] = {
    PoseGaussian: Form(bytes, unpack_pose),
    Pose2: Form(tuple[Coordinate, Coordinate, Coordinate], lambda numbers: Pose2(*numbers)),
    Camera: Form(bytes, unpack_camera),
    ChangeBody: Form(bytes, decode_body),
    Node: Form(bytes, _node),
    Edge: Form(bytes, _edge),
    Ends: Form(tuple[list[Any], list[Any]], _ends),
    Distortion: Form(list[float] | dict[str, Any], _distortion),
    tuple[MapEvent, ...]: Form(list[dict[str, Any]], _events),
    tuple[Annotation, ...]: Form(
        Annotated[list[dict[str, Any]], Meta(max_length=MAX_ANNOTATIONS)], _annotations
    ),
}
PACKERS: Packers = {
    PoseGaussian: pack_pose,
    Pose2: lambda pose: [pose.x, pose.y, pose.heading],
    Camera: pack_camera,
    Node: lambda node: encode_body(NodePut(node)),
    Edge: lambda edge: encode_body(EdgePut(edge)),
    **dict.fromkeys((NodePut, NodeRetired, EdgePut, EdgeRetired), encode_body),
    np.ndarray: lambda array: [array.dtype.str[1:], array.shape, array.tobytes()],
}


def packed(value: Any, packers: Packers = PACKERS) -> Any:
    """Return a value as plain data.

    Args:
        value: dataclasses, lists, maps, and the types of `packers`, nested in any way.
        packers: functions for types with their own form.

    Raises:
        InvalidValue: a number is out of the range of messages.
    """
    kind: Any = type(value)
    if (pack_value := packers.get(kind)) is not None:
        return pack_value(value)
    return value if kind in PLAIN else _packer(kind)(value, packers)


@cache
def _packer(kind: Any) -> Callable[[Any, Packers], Any]:
    """What makes plain data of the values of a type that has no form of its own."""
    if is_dataclass(kind):
        return _fields_packer(kind)
    if issubclass(kind, msgspec.Struct):
        return lambda value, packers: msgspec.to_builtins(value, builtin_types=(bytes,))
    if issubclass(kind, Enum):
        return lambda value, packers: value.value
    if issubclass(kind, float):
        return lambda value, packers: min(max(float(value), -MAX_FLOAT), MAX_FLOAT)
    if issubclass(kind, np.generic):
        return lambda value, packers: value.item()
    if issubclass(kind, Mapping):
        return _packed_map
    if issubclass(kind, tuple | list):
        return lambda value, packers: [packed(element, packers) for element in value]
    if issubclass(kind, Set):
        return lambda value, packers: [packed(element, packers) for element in sorted(value)]
    return lambda value, packers: value


def _fields_packer(kind: Any) -> Callable[[Any, Packers], dict[str, Any]]:
    """What packs a dataclass: the tag, if it has one, and the fields."""
    tag = {"kind": kind.TAG} if hasattr(kind, "TAG") else {}
    names = [field.name for field in fields(kind)]

    def pack_fields(value: Any, packers: Packers) -> dict[str, Any]:
        out: dict[str, Any] = tag.copy()
        for name in names:
            out[name] = packed(getattr(value, name), packers)
        return out

    return pack_fields


def _packed_map(value: Mapping[Any, Any], packers: Packers) -> Any:
    if any(isinstance(key, tuple) for key in value):
        return [[packed(key, packers), packed(element, packers)] for key, element in value.items()]
    return {key: packed(element, packers) for key, element in value.items()}


def encode(value: Any, limit: Limit) -> bytes:
    """Encode a value as a message.

    Raises:
        InvalidValue: it would not decode.
    """
    data = pack(packed(value))
    try:
        # The same rule for both sides: nothing is sent that a receiver would refuse.
        decode(data, type(value), limit)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def decode(data: bytes, kind: type[Value], limit: Limit) -> Value:
    """Decode a message.

    Raises:
        InvalidMessage: the message is invalid; one line gives the reason.
    """
    schema: Any = kind
    value: Value = unpack(data, _schema(schema), limit, _read)
    return value


def value_of(plain: Any, kind: type[Value]) -> Value:
    """A value of plain data, as `packed` returns it.

    Raises:
        InvalidValue: something is missing, of another type or out of range.
    """
    schema: Any = kind
    try:
        value: Value = _convert(plain, _schema(schema))
    except msgspec.ValidationError as error:
        raise InvalidValue(str(error).splitlines()[0]) from None
    return value


class _Opaque(type):
    """Metaclass of types that msgspec passes to `_read`. It accepts every value that `_read` returns."""

    def __instancecheck__(cls, value: object) -> bool:
        return True


@cache
def _opaque(kind: Any) -> type:
    return _Opaque("Opaque", (), {"kind": kind})


@cache
def _schema(kind: Any) -> Any:
    """Return the type for msgspec: dataclasses and types with their own form are opaque in it.

    msgspec would read a dataclass itself, without the forms of the types within.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if (alias := getattr(origin, "__value__", None)) is not None:
        # From NumPy 2.5 on `NDArray` is one.
        return _schema(alias[inner])
    by_id = origin is Mapping and (inner[0] in (NodeId, MapId) or get_origin(inner[0]) is tuple)
    if kind in FORMS or is_dataclass(kind) or origin is np.ndarray or by_id:
        return _opaque(kind)
    if origin is None or origin is Literal:
        return kind
    if origin is Annotated:
        return Annotated[_schema(inner[0]), *kind.__metadata__]
    if origin in (Union, UnionType):
        members = [member for member in inner if member is not NoneType]
        if len(members) < len(inner):
            return _schema(reduce(or_, members)) | None
        if all(hasattr(member, "TAG") for member in members):
            return _opaque(kind)
        return reduce(or_, map(_schema, members))
    return origin[tuple(member if member is ... else _schema(member) for member in inner)]


@cache
def _fields(kind: Any) -> type[msgspec.Struct]:
    """Return the fields of a dataclass as a struct; those with a default may be missing in a message."""
    hints, declared = get_type_hints(kind, include_extras=True), []
    for field in fields(kind):
        given: dict[str, Any] = {"default": field.default, "default_factory": field.default_factory}
        default = msgspec.field(**{name: value for name, value in given.items() if value is not MISSING})
        declared.append((field.name, _schema(hints[field.name]), default))
    return msgspec.defstruct(kind.__name__, declared, kw_only=True)


def _convert(plain: Any, kind: Any) -> Any:
    return convert(plain, kind, _read)


def _read(opaque: Any, plain: Any) -> Any:
    try:
        return _reader(opaque)(plain)
    except (msgspec.ValidationError, MapweaveError) as error:
        # msgspec adds the path to a ValueError.
        raise ValueError(str(error).splitlines()[0]) from None


@cache
def _reader(opaque: Any) -> Callable[[Any], Any]:
    """What makes values of an opaque type of plain data."""
    kind = opaque.kind
    if kind in FORMS:
        form = FORMS[kind]
        return lambda plain: form.read(_convert(plain, form.plain))
    if get_origin(kind) in (Union, UnionType):
        return lambda plain: _reader(_opaque(_tagged(kind, plain)))(plain)
    if is_dataclass(kind):
        return _dataclass_reader(kind)
    if get_origin(kind) is np.ndarray:
        dtype = np.dtype(get_args(get_args(kind)[1])[0])
        return lambda plain: _array(dtype, *_convert(plain, _Array))
    # An empty map is packed as a map: the type of its keys is unknown.
    pairs: Any = list[tuple[tuple(map(_schema, get_args(kind)))]] | _EmptyMap  # type: ignore[misc]
    return lambda plain: dict(_convert(plain, pairs))


def _dataclass_reader(kind: Any) -> Callable[[Any], Any]:
    struct = _fields(kind)
    return lambda plain: kind(**msgspec.structs.asdict(_convert(plain, struct)))


def _tagged(kind: Any, plain: Any) -> Any:
    """The member of a union that a tag names."""
    members = {member.TAG: member for member in get_args(kind)}
    tag = plain.get("kind") if isinstance(plain, dict) else None
    if not isinstance(tag, str) or tag not in members:
        raise InvalidValue(f"`kind` must be one of {', '.join(members)}")
    return members[tag]


_EmptyMap = Annotated[dict[str, Any], Meta(max_length=0)]
_Array = tuple[str, Annotated[list[Annotated[int, Meta(ge=0)]], Meta(max_length=3)], bytes]


def _array(dtype: np.dtype[Any], kind: str, shape: list[int], data: bytes) -> NDArray[Any]:
    if kind != dtype.str[1:] or len(data) != math.prod(shape) * dtype.itemsize:
        raise InvalidValue(f"{len(data)} bytes of kind {kind[:8]} are not an array of {shape} {dtype}")
    return np.frombuffer(data, dtype.newbyteorder("<")).astype(dtype).reshape(shape)
