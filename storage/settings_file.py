"""Tables of TOML or MessagePack into frozen dataclasses; a wrong name or value is an error."""

import dataclasses
import difflib
import math
import re
import sys
import tomllib
import types
import typing
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from mapweave.hybridmap.errors import SettingsError
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.os_errors import reason_of
from mapweave.wire.conversion import convert

T = TypeVar("T")
MOST_PARTS = 64
"""Of a key with dots: the parser takes a time that grows with the square of their number."""
_PART = r"""(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*"""
MANY_PARTS = re.compile(rf"(?:{_PART}\.[ \t]*){{{MOST_PARTS - 1}}}{_PART}")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        SettingsError: the file is missing or is not TOML.
    """
    try:
        # Editors of Windows begin a file with an invisible mark.
        text = read_whole(path).decode("utf-8-sig")
        if MANY_PARTS.search(text):
            raise SettingsError(f"{path}: a key has {MOST_PARTS} parts with dots between them, or more")
        return tomllib.loads(text)
    except FileNotFoundError:
        raise SettingsError(f"{path}: no such file") from None
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({reason_of(error)})") from None
    except UnicodeDecodeError:
        raise SettingsError(f"{path}: is not text in UTF-8, as TOML must be; give a text file") from None
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(_no_toml(path, str(error))) from None
    except (ValueError, RecursionError) as error:
        # Numbers of thousands of digits, tables nested a thousand deep.
        raise SettingsError(f"{path}: {error}") from None


def _no_toml(path: Path, error: str) -> str:
    """The error of the parser, with the place in front and what TOML looks like behind."""
    found = re.fullmatch(r"(.*) \(at (line \d+, column \d+|end of document)\)", error, re.S)
    what, place = (found[1], found[2].replace("end of document", "last line")) if found else (error, "")
    return (
        f"{path}: {place}{': ' if place else ''}is not TOML: {' '.join(what.split())}; correct it there: "
        "a table begins with a line [name], a setting is a line name = value, texts are in quotation marks"
    )


def build(cls: type[T], values: Mapping[str, Any], where: str) -> T:
    """Make a dataclass from a table; what is missing keeps its default.

    Args:
        cls: a frozen dataclass whose fields are what `msgspec.convert` knows: numbers, texts, flags, one of
            several texts (`StrEnum`), tuples, such dataclasses, or tables that are taken as they are
            (`Mapping`). Ranges are `msgspec.Meta`.
        values: the table.
        where: for the error's text, for example `robot.toml`.

    Raises:
        SettingsError: a name that does not exist or is missing, or a value of the wrong kind or out of range.
        InvalidValue: values that a dataclass itself refuses, in its own words.
    """
    for problem in _problems(cls, values, ""):
        raise SettingsError(f"{where}: {problem}")
    try:
        settings: T = convert(values, cls)
        return settings
    except msgspec.ValidationError as error:
        raise SettingsError(f"{where}: {_in_words(str(error), values, cls)}") from None
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None


def no_setting(name: str, known: Collection[str]) -> str:
    """That a file has a setting which does not exist, and which one may be meant."""
    close = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
    return f"no setting {name!r}; {hint}"


def _problems(kind: Any, value: Any, path: str) -> Iterator[str]:
    """What `msgspec.convert` lets pass: names that a dataclass does not have, numbers that are no floats."""
    kinds = list(_dataclasses(kind))
    if isinstance(value, Mapping) and kinds:
        hints = typing.get_type_hints(kinds[0], include_extras=True)
        for name, inner in value.items():
            if name not in hints:
                problem = no_setting(str(name), hints)
                yield f"{path}: {problem}" if path else problem
            else:
                yield from _problems(hints[name], inner, f"{path}.{name}" if path else name)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _problems(kind, inner, path)
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"{path}: {value!r} is no float"
    elif isinstance(value, int) and abs(value) > sys.float_info.max:
        yield f"{path}: the number has too many digits"


def _dataclasses(kind: Any) -> Iterator[Any]:
    """The dataclasses that a type hint names, by itself or within a union, a tuple or an annotation."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        yield kind
    elif typing.get_origin(kind) in (types.UnionType, typing.Union, tuple, typing.Annotated):
        for inner in typing.get_args(kind):
            yield from _dataclasses(inner)


def _in_words(error: str, values: Mapping[str, Any], cls: type) -> str:
    """The error of msgspec as `path: what is wrong; what is there`.

    Args:
        error: for example ``Expected `float` > 0.0 - at `$.agent.navigation.speed` ``.
        values: the table.
        cls: what was to be made of it.
    """
    what, _, place = error.partition(" - at `$")
    path = place.rstrip("`").lstrip(".")
    there: Any = values
    hints: list[Any] = [cls]
    for name, number in re.findall(r"([^.\[\]]+)|\[(\d+)\]", path):
        there = there[int(number)] if number else there[name]
        hints = [inner for hint in hints for inner in _inside(hint, name)]
    if missing := re.fullmatch(r"Object missing required field `(\w+)`", what):
        what = f": {missing[1]} is missing"
    elif re.fullmatch(r"Expected `(int|float)` [<>]=? .*", what) and (ranges := _ranges(hints)):
        what = f" must be {' or '.join(ranges)}; it is {there!r}"
    else:
        what = f": {what[:1].lower()}{what[1:]}".replace("`", "")
        what = what.replace("object", "table").replace("array", "list")
        if not isinstance(there, Mapping | list):
            what = f"{what}; it is {there!r}"
    return f"{path}{what}".removeprefix(": ")


def _inside(hint: Any, name: str) -> Iterator[Any]:
    """The type hints of a dataclass's field, or, without a name, of what a tuple holds."""
    if name:
        for kind in _dataclasses(hint):
            yield typing.get_type_hints(kind, include_extras=True).get(name)
    elif typing.get_origin(hint) is tuple:
        yield from typing.get_args(hint)
    else:
        for inner in typing.get_args(hint):
            yield from _inside(inner, name)


def _ranges(hints: Iterable[Any]) -> list[str]:
    """What numbers may be: for example `a whole number, 1 to 16`."""
    out: list[str] = []
    for hint in hints:
        if typing.get_origin(hint) is not typing.Annotated:
            out += _ranges(typing.get_args(hint))
            continue
        kind, *metas = typing.get_args(hint)
        for meta in metas:
            if isinstance(meta, msgspec.Meta) and kind in (int, float):
                out.append(f"a {'whole ' if kind is int else ''}number, {_range(meta)}")
    return list(dict.fromkeys(out))


def _range(meta: msgspec.Meta) -> str:
    """The range in words, both ends of it."""
    if meta.ge is not None and meta.le is not None:
        return f"{_plain(meta.ge)} to {_plain(meta.le)}"
    ends = (
        (meta.ge, "{} or more"), (meta.gt, "above {}"), (meta.le, "at most {}"), (meta.lt, "below {}")
    )  # fmt: skip
    return ", ".join(words.format(_plain(end)) for end, words in ends if end is not None)


def _plain(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"
