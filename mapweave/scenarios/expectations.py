"""Expectations: what a scenario demands of a trial's figures, and what came of it."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mapweave.hybridmap.errors import SettingsError
from mapweave.scenarios.figures import MORE_IS_BETTER, Figures, as_text, kinds

Value = bool | int | float | str


@dataclass(frozen=True)
class Expectation:
    """What one figure shall be: one value, or a number within bounds.

    Attributes:
        name: of the figure.
        equal: the one value.
        least: lower bound, included.
        most: upper bound, included.
    """

    name: str
    equal: Value | None = None
    least: float | None = None
    most: float | None = None

    def accepts(self, value: Value) -> bool:
        """Whether a measured value is as it shall be."""
        if self.equal is not None:
            return value == self.equal
        assert not isinstance(value, str)
        return (self.least is None or value >= self.least) and (self.most is None or value <= self.most)

    def __str__(self) -> str:
        """The expectation in words."""
        if self.equal is not None:
            return as_text(self.equal)
        if self.least is not None and self.most is not None:
            return f"{as_text(self.least)} to {as_text(self.most)}"
        if self.least is not None:
            return f"at least {as_text(self.least)}"
        return f"at most {as_text(self.most)}"


@dataclass(frozen=True)
class ExpectationResult:
    """What came of one expectation.

    Attributes:
        name: of the figure.
        wanted: in words.
        measured: the figure; None if it was not measured.
        good: whether it is as it shall be.
    """

    name: str
    wanted: str
    measured: Value | None
    good: bool

    def __str__(self) -> str:
        """One line."""
        was = "not measured" if self.measured is None else as_text(self.measured)
        return f"{self.name} is {was}, wanted {self.wanted}"


def parse_expectations(table: Mapping[str, Any], where: str = "expect") -> tuple[Expectation, ...]:
    """Read a scenario's `[expect]` table.

    A key is the name of a figure (see Figures). A value is a table with `min`, `max` or both, or plain:
    counts, flags and texts must then be equal; a measured figure must be at most that, or at least that
    where more is better (`link_precision`, `link_recall`, `real_time_factor`).

    Args:
        table: as TOML has it.
        where: for the error's text.

    Raises:
        SettingsError: an unknown figure, a value of the wrong kind, or bounds that nothing can meet.
    """
    figure_kinds = kinds()
    expectations = []
    for name, value in table.items():
        if name not in figure_kinds:
            close = difflib.get_close_matches(name, figure_kinds, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(figure_kinds)}"
            raise SettingsError(f"{where}: no figure {name!r}; {hint}")
        expectations.append(_parse(name, figure_kinds[name], value, f"{where}: {name}"))
    return tuple(expectations)


def check(figures: Figures, expectations: Sequence[Expectation]) -> list[ExpectationResult]:
    """Judge. What was not measured is not good."""
    verdicts = []
    for wanted in expectations:
        value: Value | None = getattr(figures, wanted.name)
        verdicts.append(
            ExpectationResult(wanted.name, str(wanted), value, value is not None and wanted.accepts(value))
        )
    return verdicts


def _parse(name: str, kind: type, value: Any, where: str) -> Expectation:
    if isinstance(value, Mapping):
        return _parse_bounds(name, kind, value, where)
    if kind is float:
        bound = _number(value, where)
        return Expectation(name, least=bound) if name in MORE_IS_BETTER else Expectation(name, most=bound)
    if not isinstance(value, bool | int | str) or type(value) is not kind:
        raise SettingsError(f"{where}: {value!r} is no {_called(kind)}")
    return Expectation(name, equal=value)


def _parse_bounds(name: str, kind: type, table: Mapping[str, Any], where: str) -> Expectation:
    if kind not in (int, float):
        raise SettingsError(f"{where}: is a {_called(kind)}, it has no min and max")
    for key in table:
        if key not in ("min", "max"):
            raise SettingsError(f"{where}: no bound {key!r}; known are min, max")
    if not table:
        raise SettingsError(f"{where}: give min, max or both")
    least, most = (_number(table[k], f"{where}: {k}") if k in table else None for k in ("min", "max"))
    if least is not None and most is not None and least > most:
        raise SettingsError(f"{where}: min {as_text(least)} is above max {as_text(most)}")
    return Expectation(name, least=least, most=most)


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"{where}: {value!r} is no number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise SettingsError(f"{where}: must be a finite number")
    return number


def _called(kind: type) -> str:
    return {bool: "true or false", int: "whole number", str: "text"}[kind]
