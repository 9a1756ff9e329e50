"""Which cases of a parametrized test run in `make test`, in `make slow` or in `make scenarios`."""

from collections.abc import Iterable
from typing import Any

import pytest


def first_quick(cases: Iterable[Any], quick: int, in_gate: int | None = None) -> list[Any]:
    """The cases, of which all after the first `quick` are marked slow.

    Args:
        cases: tuples of arguments, or one argument each.
        quick: so many are not marked.
        in_gate: all after so many are marked as scenarios, where cases differ by chance alone; None: none.
    """
    tuples = [case if isinstance(case, tuple) else (case,) for case in cases]
    gate = len(tuples) if in_gate is None else in_gate
    marks = [
        [] if k < quick else pytest.mark.slow if k < gate else pytest.mark.scenario
        for k in range(len(tuples))
    ]
    return [pytest.param(*case, marks=mark) for case, mark in zip(tuples, marks, strict=True)]
