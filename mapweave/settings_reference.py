"""All settings with their defaults, units and ranges: as a TOML file, and as the page `docs/settings.md`."""

import dataclasses
import inspect
import json
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec

from mapweave.settings import Settings

ROLES = (
    ("a robot: `mapweave agent`, `replay`", "`[network]`, `[robot]`, `[agent]`"),
    (
        "the server: `mapweave server`",
        "`[network]`, `[admission_control]`, `[merge]`, `[quotas]`, `[attendance]`, `[cluster]`",
    ),
    ("people who ask a server: `mapweave relocalize`, `map`", "`[network]`"),
    ("people with map files: `mapweave map`", "`[merge]`"),
    ("simulation and recordings: `mapweave sim`, `eval`", "`[agent]`, `[merge]`"),
    ("bags: `mapweave replay`, `info`, `eval replay`, `calibrate drive`", "`[recording]`"),
)
"""Commands that take `--settings FILE`, and the parts of the file that each reads."""

INTRODUCTION = """\
# Settings

Made by `mapweave settings --markdown`; a test fails if it is not current.

A settings file is TOML and is given to a command as `--settings FILE`. It holds only what differs from the
defaults. A name that does not exist, or a value of the wrong kind or out of range, ends the command with one
line that says where. `mapweave settings` prints a whole file with all defaults to start from. What has no
default stands there behind a `#`.
"""

BOUNDS = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}
"""Fields of `msgspec.Meta` in words."""


@dataclass(frozen=True)
class SettingLine:
    """One line of a settings file.

    Attributes:
        name: in its section.
        default: as TOML; empty if there is none.
        text: what it is, with its unit.
        bounds: which values it may have; empty for all of its kind.
    """

    name: str
    default: str
    text: str
    bounds: str


@dataclass(frozen=True)
class Section:
    """A table of a settings file.

    Attributes:
        name: as it stands in brackets.
        text: what it is about.
        settings: its lines.
        optional: whether a file without the table is complete, though a line of the table has no default.
    """

    name: str
    text: str
    settings: tuple[SettingLine, ...]
    optional: bool


def sections(cls: type = Settings, name: str = "", optional: bool = False) -> Iterator[Section]:
    """All tables of a settings file that have lines of their own, the outer ones first."""
    hints = typing.get_type_hints(cls, include_extras=True)
    summary, texts = _documented(cls)
    lines, inner = [], []
    for one in dataclasses.fields(cls):
        hint, default = hints[one.name], _default(one)
        kind = next((k for k in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(k)), None)
        if isinstance(kind, type):
            inner.append((kind, f"{name}.{one.name}" if name else one.name, default is None))
        else:
            lines.append(SettingLine(one.name, _toml(default), texts[one.name], _bounds(hint)))
    if lines:
        yield Section(name, summary, tuple(lines), optional)
    for kind, path, absent in inner:
        yield from sections(kind, path, absent)


def as_toml() -> str:
    """A settings file that says what holds without one."""
    out = []
    for section in sections():
        out.append(f"# {section.text}\n{'#' if section.optional else ''}[{section.name}]")
        for one in section.settings:
            more = f" {one.bounds[:1].upper()}{one.bounds[1:]}." if one.bounds else ""
            off = "#" if section.optional or not one.default else ""
            out += [_wrapped(f"{one.text}{more}"), f"{off}{one.name} = {one.default}".rstrip()]
        out.append("")
    return "\n".join(out).rstrip() + "\n"


def as_markdown() -> str:
    """The page `docs/settings.md`."""
    every = list(sections())
    count = sum(len(section.settings) for section in every)
    out = [INTRODUCTION, f"There are {count} settings.\n", "| command | reads |\n|---|---|"]
    out += [f"| {command} | {read} |" for command, read in ROLES]
    for section in every:
        out += [
            f"\n## `[{section.name}]`\n\n{section.text}\n",
            "| name | default | range | meaning |\n|---|---|---|---|",
        ]
        for one in section.settings:
            cells = (f"`{one.name}`", f"`{one.default}`" if one.default else "", one.bounds, one.text)
            out.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(out) + "\n"


def _documented(cls: type) -> tuple[str, dict[str, str]]:
    """A class's docstring: its first paragraph, and what it says of each attribute."""
    summary, _, rest = (inspect.getdoc(cls) or "").partition("\n\nAttributes:\n")
    entries = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", rest, re.MULTILINE)
    return " ".join(summary.split()), {name: _sentence(text) for name, text in entries}


def _sentence(text: str) -> str:
    joined = " ".join(text.split())
    return f"{joined[:1].upper()}{joined[1:]}"


def _bounds(hint: Any) -> str:
    """The ranges of an annotated type in words."""
    metas = [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, msgspec.Meta)]
    words = [
        f"{word} {getattr(one, key):g}"
        for one in metas
        for key, word in BOUNDS.items()
        if getattr(one, key) is not None
    ]
    return ", ".join(words)


def _default(one: dataclasses.Field[Any]) -> Any:
    """What a field holds without a file; `MISSING` if the file must give it."""
    return one.default if one.default_factory is dataclasses.MISSING else one.default_factory()


def _toml(value: Any) -> str:
    """A plain value as TOML, whose texts, lists and flags are written as in JSON; empty if there is none."""
    return "" if value is None or value is dataclasses.MISSING else json.dumps(value)


def _wrapped(text: str) -> str:
    """Comment lines."""
    lines, width = [""], 100
    for word in text.split():
        if len(lines[-1]) + len(word) > width:
            lines.append("")
        lines[-1] += f" {word}"
    return "\n".join(f"#{line}" for line in lines)
