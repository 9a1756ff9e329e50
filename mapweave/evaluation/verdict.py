"""What became of one question, and the figures of many."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapweave.hybridmap.query import Certainty

SURE = (Certainty.FOUND, Certainty.PLACE)
"""Answers that name one place."""
LEVELS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Position (m) and heading (degrees) within which an answer is fine, medium, coarse (Sattler et al. 2018)."""


@dataclass(frozen=True)
class JudgedAnswer:
    """An answer to one question, compared with the recording.

    Attributes:
        query: its image.
        expected: whether the map shows the place; None if unknown.
        certainty: of the answer.
        place: the node or image that was named; empty if none was.
        right: whether that is correct by the recording; None if unknown.
        first: the same of the place that was ranked first, before it was verified.
        error_m: of the position; NaN if unknown.
        error_deg: of the heading.
        error_frames: how many images the answered one is from the best one.
        extract_ms: to find the image's features.
        answer_ms: from features to answer.
    """

    query: str
    expected: bool | None
    certainty: Certainty
    place: str = ""
    right: bool | None = None
    first: bool | None = None
    error_m: float = math.nan
    error_deg: float = math.nan
    error_frames: float = math.nan
    extract_ms: float = math.nan
    answer_ms: float = math.nan

    def within(self, metres: float, degrees: float) -> bool:
        """Whether the pose is known to be that near to the true one."""
        return self.error_m <= metres and self.error_deg <= degrees


def figures(verdicts: Sequence[JudgedAnswer]) -> dict[str, Any]:
    """Figures by name; None without truth in the recording.

    Returns:
        `recall_at_1`, of the questions whose place is mapped, those answered FOUND and right;
        `retrieved_at_1`, those whose first candidate is right, before it is verified; `precision`, of the
        answers FOUND, those that are right; `by_place`, answers PLACE, and how many of them are right;
        `place_at_1`, of the questions whose place is mapped, FOUND or PLACE and right; `unknown_share` and
        `ambiguous_share` of all questions; `false_accept`, of the questions whose place is not mapped, those
        answered FOUND or PLACE and wrongly; errors of the answers FOUND; times.
    """
    expected = [v for v in verdicts if v.expected]
    elsewhere = [v for v in verdicts if v.expected is False]
    localized = [v for v in verdicts if v.certainty is Certainty.FOUND]
    judged = [v for v in localized if v.right is not None]
    by_place = [v for v in verdicts if v.certainty is Certainty.PLACE]
    report: dict[str, Any] = {
        "queries": len(verdicts),
        "expected": len(expected),
        "found": len(localized),
        "recall_at_1": _share([v.certainty is Certainty.FOUND and bool(v.right) for v in expected]),
        "retrieved_at_1": _share([bool(v.first) for v in expected if v.first is not None]),
        "precision": _share([bool(v.right) for v in judged]),
        "found_wrong": sum(not v.right for v in judged) if judged else None,
        "by_looks": len(by_place),
        "by_looks_precision": _share([bool(v.right) for v in by_place if v.right is not None]),
        "place_at_1": _share([v.certainty in SURE and bool(v.right) for v in expected]),
        "unknown_share": _share([v.certainty is Certainty.UNKNOWN for v in verdicts]),
        "ambiguous_share": _share([v.certainty is Certainty.AMBIGUOUS for v in verdicts]),
        "false_accept": _share([v.certainty in SURE and v.right is False for v in elsewhere]),
    }
    if any(math.isfinite(v.error_m) for v in localized):
        for metres, degrees in LEVELS:
            name = f"recall_{metres:g}m_{degrees:g}deg"
            report[name] = _share(
                [v.certainty is Certainty.FOUND and v.within(metres, degrees) for v in expected]
            )
    for name in ("error_m", "error_deg", "error_frames"):
        values = [getattr(v, name) for v in localized if math.isfinite(getattr(v, name))]
        if values:
            report[f"{name}_median"] = round(float(np.median(values)), 3)
            report[f"{name}_p95"] = round(float(np.percentile(values, 95)), 3)
    for name in ("extract_ms", "answer_ms"):
        values = [getattr(v, name) for v in verdicts if math.isfinite(getattr(v, name))]
        if values:
            report[f"{name}_p50"] = round(float(np.median(values)), 1)
            report[f"{name}_p95"] = round(float(np.percentile(values, 95)), 1)
    return report


def _share(hits: Sequence[bool]) -> float | None:
    return round(sum(hits) / len(hits), 4) if hits else None


def shown(value: object) -> str:
    """A figure for people."""
    return "unknown" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
