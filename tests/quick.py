"""Which cases of a parametrized test run in `make test`; the others run in `make slow`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def first_quick(cases: Iterable[Any], quick: int) -> list[Any]:
    """The cases, of which all after the first `quick` are marked slow."""
    tuples = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [
        pytest.param(*case, marks=[pytest.mark.slow] if k >= quick else []) for k, case in enumerate(tuples)
    ]
