"""Tables of TOML or MessagePack into frozen dataclasses; a wrong name or value is an error."""

from __future__ import annotations

import dataclasses
import difflib
import enum
import sys
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from mapweave.hybridmap.errors import SettingsError
from mapweave.storage.atomic_file import read_whole

T = TypeVar("T")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SettingsError: the file is missing or is not TOML.
    """
    try:
        return tomllib.loads(read_whole(path).decode("utf-8"))
    except FileNotFoundError:
        raise SettingsError(f"{path}: no such file") from None
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise SettingsError(f"{path}: is not text in UTF-8, as TOML must be") from None
    except (ValueError, RecursionError) as error:
        # In addition to invalid TOML: numbers of thousands of digits, tables nested a thousand deep.
        raise SettingsError(f"{path}: {error}") from None


def build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """Make a dataclass from a table; what is missing keeps its default.

    Args:
        cls: a frozen dataclass whose fields are numbers, texts, flags, one of several texts (`StrEnum`),
            tuples, such dataclasses, or tables that are taken as they are (`Mapping`).
        values: the table.
        where: for the error's text, for example `robot.toml: pipeline`.

    Raises:
        SettingsError: a name that does not exist or is missing, or a value of the wrong kind.
    """
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    given: dict[str, Any] = {}
    for name, value in values.items():
        if name not in names:
            close = difflib.get_close_matches(name, names, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(names)}"
            raise SettingsError(f"{where}: no setting {name!r}; {hint}")
        given[name] = _convert(hints[name], value, f"{where}: {name}")
    for item in dataclasses.fields(cls):  # type: ignore[arg-type]
        optional = item.default is not dataclasses.MISSING or item.default_factory is not dataclasses.MISSING
        if item.name not in given and not optional:
            raise SettingsError(f"{where}: {item.name} is missing")
    try:
        return cls(**given)
    except (ValueError, SettingsError) as error:
        raise SettingsError(f"{where}: {error}") from None


def _convert(kind: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if isinstance(value, kind):
            return value
        if not isinstance(value, Mapping):
            raise SettingsError(f"{where}: must be a table")
        return build(kind, value, where)
    origin = typing.get_origin(kind)
    if origin in (types.UnionType, typing.Union):
        inner = [k for k in typing.get_args(kind) if k is not type(None)]
        return _convert(inner[0], value, where)
    if origin is Mapping:
        if not isinstance(value, Mapping):
            raise SettingsError(f"{where}: must be a table")
        return dict(value)
    if isinstance(kind, type) and issubclass(kind, enum.StrEnum):
        if value not in list(kind):
            raise SettingsError(f"{where}: {value!r} is none of {', '.join(kind)}")
        return kind(value)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise SettingsError(f"{where}: must be a list")
        kinds = typing.get_args(kind)
        if kinds[-1] is Ellipsis:
            kinds = (kinds[0],) * len(value)
        if len(value) != len(kinds):
            raise SettingsError(f"{where}: must be a list of {len(kinds)}")
        return tuple(_convert(item_kind, v, where) for item_kind, v in zip(kinds, value, strict=True))
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        # A comparison with "not a number" is false; an integer of TOML may be larger than any float.
        if not -sys.float_info.max <= value <= sys.float_info.max:
            raise SettingsError(f"{where}: {value!r} is no float")
        return float(value)
    if kind in (int, str, bool) and isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    raise SettingsError(f"{where}: {value!r} is no {getattr(kind, '__name__', kind)}")
