"""Many trials of one scenario: median and worst of each figure, and the failures by seed."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from mapweave.scenarios.expectations import ExpectationResult
from mapweave.scenarios.figures import MORE_IS_BETTER, Figures, as_text, kinds

COUNTS_WITHOUT_WORST = frozenset({"components", "maps", "nodes", "edges", "loops", "links", "sim_s"})
"""Neither more nor less of them is better: least and most are shown."""


@dataclass(frozen=True)
class Attempt:
    """One trial of a batch.

    Attributes:
        seed: of the trial.
        figures: None if it could not be run to its end.
        verdicts: what came of the scenario's expectations.
        failure: why it could not be run, else empty.
    """

    seed: int
    figures: Figures | None = None
    verdicts: Sequence[ExpectationResult] = ()
    failure: str = ""

    @property
    def passed(self) -> bool:
        """Whether it ran to its end and every expectation was met."""
        return self.figures is not None and not self.failure and all(v.good for v in self.verdicts)

    @property
    def complaints(self) -> list[str]:
        """What was not as it should be, a line each."""
        broken = [self.failure or "it was not run to its end"] if self.failure or self.figures is None else []
        return broken + [str(v) for v in self.verdicts if not v.good]


@dataclass(frozen=True)
class Summary:
    """One figure over a batch.

    Attributes:
        name: of the figure.
        median: of the trials that measured it.
        worst: likewise; of counts that are neither good nor bad: None.
        worst_seed: where the worst was.
        least: the smallest.
        most: the largest.
        measured: how many trials measured it.
    """

    name: str
    median: float
    least: float
    most: float
    measured: int
    worst: float | None = None
    worst_seed: int | None = None


def summarise(attempts: Sequence[Attempt]) -> list[Summary]:
    """Median and worst of each figure that any trial measured; flags count as 1 and 0."""
    summaries = []
    for name, kind in kinds().items():
        if kind is str:
            continue
        values = [
            (float(value), attempt.seed)
            for attempt in attempts
            if attempt.figures is not None and (value := getattr(attempt.figures, name)) is not None
        ]
        if not values:
            continue
        numbers = [value for value, _ in values]
        worst: tuple[float, int] | tuple[None, None] = (None, None)
        if name not in COUNTS_WITHOUT_WORST:
            # Of equals, the first seed: the order of the trials decides nothing.
            more = name in MORE_IS_BETTER or kind is bool
            worst = min(values) if more else min(values, key=lambda pair: (-pair[0], pair[1]))
        summaries.append(
            Summary(name, statistics.median(numbers), min(numbers), max(numbers), len(values), *worst)
        )
    return summaries


def batch_json(attempts: Sequence[Attempt]) -> dict[str, Any]:
    """The whole batch for JSON."""
    return {
        "trials": len(attempts),
        "passed": sum(a.passed for a in attempts),
        "failed": {str(a.seed): a.complaints for a in attempts if not a.passed},
        "figures": {
            s.name: {
                "median": s.median,
                "worst": s.worst,
                "worst_seed": s.worst_seed,
                "min": s.least,
                "max": s.most,
                "measured": s.measured,
            }
            for s in summarise(attempts)
        },
        "seeds": {
            str(a.seed): {"passed": a.passed, "figures": a.figures.as_dict() if a.figures else None}
            for a in attempts
        },
    }


def batch_table(attempts: Sequence[Attempt], title: str = "") -> Group:
    """The whole batch for people: figures, then the failures by seed."""
    figures = Table(title=Text(title) if title else None)
    for heading in ("figure", "median", "worst", "of seed", "range", "trials"):
        figures.add_column(heading, justify="left" if heading == "figure" else "right")
    judged = {v.name: v.wanted for a in attempts for v in a.verdicts}
    for row in summarise(attempts):
        figures.add_row(
            Text(row.name, "bold" if row.name in judged else ""),
            _shown(row.name, row.median),
            _shown(row.name, row.worst),
            as_text(row.worst_seed),
            f"{_shown(row.name, row.least)} .. {_shown(row.name, row.most)}",
            f"{row.measured} of {len(attempts)}",
        )
    failed = [a for a in attempts if not a.passed]
    lines = [Text(f"{len(attempts) - len(failed)} of {len(attempts)} passed", "bold")]
    lines += [Text(f"seed {a.seed} failed: " + "; ".join(a.complaints), "red") for a in failed]
    return Group(figures, *lines)


def _shown(name: str, value: float | None) -> str:
    """A figure for people; a median of flags is the share that is true."""
    if kinds()[name] is not bool or value not in (0.0, 1.0):
        return as_text(value)
    return as_text(bool(value))
