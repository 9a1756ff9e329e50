"""docs/figures.md, written of stored results alone."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.figures.questions import INTRODUCTION, QUESTIONS, Question
from benchmarks.figures.results import StoredResult
from benchmarks.figures.rules import RULES, Rule
from mapweave.hybridmap.errors import InvalidValue

FIELD = re.compile(r"\{([^{}:]+)(?::([^{}]*))?\}")
"""`{path/of/keys:format}`; a format that ends in `k` or `m` shows thousands or thousandths."""
SCALES = {"k": 1e-3, "m": 1e3}


def filled(template: str, figures: Mapping[str, Any]) -> str:
    """A template with the figures of a result.

    Raises:
        InvalidValue: the result does not have a figure.
    """
    return FIELD.sub(lambda found: _shown(figures, found[1], found[2] or ""), template)


def _shown(figures: Mapping[str, Any], path: str, form: str) -> str:
    value: Any = figures
    for key in path.split("/"):
        if not isinstance(value, Mapping) or key not in value:
            raise InvalidValue(f"no figure {path}")
        value = value[key]
    if value is None:
        return "none"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if form[-1:] in SCALES:
        return format(value * SCALES[form[-1]], form[:-1] + "f")
    return format(value, form)


def page(results: Mapping[str, StoredResult]) -> str:
    """The whole page.

    Raises:
        InvalidValue: a result or one of its figures is missing.
    """
    parts = ["# Figures", INTRODUCTION, *(_question(one, results) for one in QUESTIONS)]
    parts += [_rules(RULES, results), _measured(results)]
    return "\n\n".join(parts) + "\n"


def _question(question: Question, results: Mapping[str, StoredResult]) -> str:
    lines = [f"## {question.title}", "", "| what | figure | asked | command |", "|---|---|---|---|"]
    before = ""
    for row in question.rows:
        result = _of(results, row.source)
        command = "same" if row.source == before else _command(result)
        lines.append(f"| {row.what} | {filled(row.figure, result.figures)} | {row.asked} | {command} |")
        before = row.source
    return "\n".join(lines)


def _rules(rules: Sequence[Rule], results: Mapping[str, StoredResult]) -> str:
    lines = [
        "## What fails without each rule", "",
        "A rule that rejects links, answers or frames is switched off by itself; everything else stays.", "",
        "| rule | file | what fails without it | command |", "|---|---|---|---|",
    ]  # fmt: skip
    before = ""
    for rule in rules:
        reasons = "; ".join(_reason(results, *one) for one in rule.fails)
        named = dict.fromkeys(_command(_of(results, source)) for _, source in rule.fails if source)
        commands = ", ".join(named) or "none is stored"
        lines.append(
            f"| {rule.name} | `{rule.file}` | {reasons} | {'same' if commands == before else commands} |"
        )
        before = commands
    return "\n".join(lines)


def _reason(results: Mapping[str, StoredResult], words: str, source: str) -> str:
    """What fails without a rule, with the figures of the named result; without a name it has none."""
    return filled(words, _of(results, source).figures) if source else words


def _measured(results: Mapping[str, StoredResult]) -> str:
    lines = [
        "## When and where", "",
        "`DATA` is the folder of recordings. Minutes are those of the processor.", "",
        "| name | command | date | version | machine | minutes |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {name} | {_command(one)} | {one.date} | {one.version} | {one.machine} | {one.minutes:g} |"
        for name, one in results.items()
    ]
    return "\n".join(lines)


def _command(result: StoredResult) -> str:
    return f"`{result.command.removesuffix(' --json')}`"


def _of(results: Mapping[str, StoredResult], name: str) -> StoredResult:
    if name not in results:
        raise InvalidValue(f"no result {name}: python -m benchmarks.figures --run {name}")
    return results[name]
