"""`msgspec.convert` and a decoder of JSON for programs with several threads.

msgspec gathers what it knows of a type when the type is first used, and keeps it at the type before it is
complete. Another thread that uses the type meanwhile reads a null pointer: the program ends with a
segmentation fault. Here one thread at a time gathers it, and no other uses the type before.
"""

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec

Value = TypeVar("Value")

_gathering = threading.Lock()
_gathered: set[Any] = set()


def convert(plain: Any, kind: Any, read: Callable[[Any, Any], Any] | None = None) -> Any:
    """Make a value of plain data; bytes are plain data too.

    Args:
        plain: numbers, texts, bytes, lists and maps.
        kind: the type of the value.
        read: returns values of types that msgspec does not know, of the type and plain data.

    Raises:
        msgspec.ValidationError: the plain data does not fit the type.
    """
    if kind not in _gathered:
        _gather(kind)
    return msgspec.convert(plain, kind, builtin_types=(bytes,), dec_hook=read)


def json_value(data: bytes, kind: type[Value]) -> Value:
    """Read a value from JSON.

    Raises:
        msgspec.DecodeError: it is no JSON, or does not fit the type.
    """
    if kind not in _gathered:
        _gather(kind)
    return msgspec.json.decode(data, type=kind)


def _gather(kind: Any) -> None:
    with _gathering:
        msgspec.json.Decoder(kind, dec_hook=_unused)
        _gathered.add(kind)


def _unused(kind: Any, plain: Any) -> Any:
    raise NotImplementedError(kind)
