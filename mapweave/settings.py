"""Settings: TOML into the parts' own dataclasses. Defaults work; a wrong name or value says so at once."""

from __future__ import annotations

import dataclasses
import difflib
import sys
import tomllib
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

from agent.pipeline import PipelineSettings
from hybridmap.errors import SettingsError

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class NetworkSettings:
    """How to reach the fleet.

    Attributes:
        fleet: name that robots, server and simulator share.
        endpoints: Zenoh endpoints of the router, tried in order.
        server: name of the map server that must have a change before the agent may forget it.
    """

    fleet: str = "demo"
    endpoints: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    server: str = "s0"


@dataclasses.dataclass(frozen=True)
class Settings:
    """All settings of a process; each role reads what it needs."""

    network: NetworkSettings = dataclasses.field(default_factory=NetworkSettings)
    pipeline: PipelineSettings = dataclasses.field(default_factory=PipelineSettings)


def load_settings(path: Path | None) -> Settings:
    """Read a TOML file over the defaults; None gives the defaults.

    Raises:
        SettingsError: the file is missing, is not TOML, or names or values are wrong.
    """
    if path is None:
        return Settings()
    return build(Settings, read_toml(path), str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SettingsError: the file is missing or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SettingsError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SettingsError(f"{path}: {error}") from None


def build(cls: type[T], values: dict[str, Any], where: str) -> T:
    """Make a settings dataclass from a table; what is missing keeps its default.

    Args:
        cls: a frozen dataclass whose fields are numbers, texts, flags, tuples or such dataclasses.
        values: the table.
        where: for the error's text, for example `robot.toml: pipeline`.

    Raises:
        SettingsError: a name that does not exist, or a value of the wrong kind.
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
    try:
        return cls(**given)
    except ValueError as error:
        raise SettingsError(f"{where}: {error}") from None


def _convert(kind: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, dict):
            raise SettingsError(f"{where}: must be a table")
        return build(kind, value, where)
    origin = typing.get_origin(kind)
    if origin in (types.UnionType, typing.Union):
        inner = [k for k in typing.get_args(kind) if k is not type(None)]
        return _convert(inner[0], value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise SettingsError(f"{where}: must be a list")
        kinds = typing.get_args(kind)
        if kinds[-1] is Ellipsis:
            kinds = (kinds[0],) * len(value)
        if len(value) != len(kinds):
            raise SettingsError(f"{where}: must be a list of {len(kinds)}")
        return tuple(_convert(one, v, where) for one, v in zip(kinds, value, strict=True))
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        # A comparison with "not a number" is false; an integer of TOML may be larger than any float.
        if not -sys.float_info.max <= value <= sys.float_info.max:
            raise SettingsError(f"{where}: {value!r} is no float")
        return float(value)
    if kind in (int, str, bool) and isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    raise SettingsError(f"{where}: {value!r} is no {getattr(kind, '__name__', kind)}")
