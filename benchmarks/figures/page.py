"""docs/figures.md and README.md's table, filled in from stored results alone.

`page.md` and `readme_table.md` beside this file are the templates. `{result/path/of/keys:format}` is
a figure; `{command}` becomes the commands behind the figures of its row, `{measured}` a row of each
result.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.figures.results import StoredResult
from mapweave.hybridmap.errors import InvalidValue

PAGE = Path(__file__).with_name("page.md")
README_TABLE = Path(__file__).with_name("readme_table.md")
FIELD = re.compile(r"\{([^{}:/]+/[^{}:]+)(?::([^{}]*))?\}")
"""A figure; a format that ends in `k` or `m` shows thousands or thousandths, `bytes` bytes in words."""
SCALES = {"k": 1e-3, "m": 1e3}
UNITS = {"TB": 1e12, "GB": 1e9, "MB": 1e6, "kB": 1e3}


def filled(template: str, figures: Mapping[str, Any]) -> str:
    """A template with figures.

    Args:
        template: with fields.
        figures: JSON object of each result, by its name.

    Raises:
        InvalidValue: a result is missing, or does not have a figure.
    """
    return FIELD.sub(lambda found: _shown(figures, found[1], found[2] or ""), template)


def _shown(figures: Mapping[str, Any], path: str, form: str) -> str:
    value: Any = figures
    for key in path.split("/"):
        if not isinstance(value, Mapping) or key not in value:
            raise InvalidValue(f"no figure {path}")
        value = value[key]
    if value is None or isinstance(value, str):
        return value or "none"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if form == "bytes":
        unit = next(unit for unit, size in UNITS.items() if value >= size)
        return f"{value / UNITS[unit]:.3g} {unit}"
    if form[-1:] in SCALES:
        return format(value * SCALES[form[-1]], form[:-1] + "f")
    return format(value, form)


def page(results: Mapping[str, StoredResult]) -> str:
    """The whole page.

    Raises:
        InvalidValue: a result or one of its figures is missing.
    """
    figures = {name: result.figures for name, result in results.items()}
    lines, before = [], ""
    for template in PAGE.read_text(encoding="utf-8").splitlines():
        line = filled(template, figures)
        if "{command}" in line:
            named = dict.fromkeys(
                _command(results[path.split("/")[0]]) for path, _ in FIELD.findall(template)
            )
            commands = ", ".join(named) or "none is stored"
            line = line.replace("{command}", "same" if commands == before else commands)
            before = commands
        else:
            before = ""
        lines += [_measured(*one) for one in results.items()] if line == "{measured}" else [line]
    return "\n".join(lines) + "\n"


def with_table(text: str, results: Mapping[str, StoredResult]) -> str:
    """README.md with the table of stored results.

    Raises:
        InvalidValue: there is not one table, or a figure is missing.
    """
    template = README_TABLE.read_text(encoding="utf-8")
    head = "".join(template.splitlines(keepends=True)[:2])
    table = filled(template, {name: result.figures for name, result in results.items()})
    made, tables = re.subn(rf"{re.escape(head)}(?:\|.*\n)*", lambda _: table, text)
    if tables != 1:
        raise InvalidValue(f"README.md has {tables} tables of figures instead of one")
    return made


def _measured(name: str, one: StoredResult) -> str:
    return f"| {name} | {_command(one)} | {one.date} | {one.version} | {one.machine} | {one.minutes:g} |"


def _command(result: StoredResult) -> str:
    return f"`{result.command.removesuffix(' --json')}`"
