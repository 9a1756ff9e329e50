"""What an examination has found."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class FindingLevel(StrEnum):
    """How good or bad a finding is."""

    GOOD = "good"
    WARNING = "warning"
    """It works, with a disadvantage."""
    WRONG = "wrong"
    SKIPPED = "skipped"
    """It was not examined."""


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        subject: what was examined, for example "camera".
        verdict: on it.
        detail: in words and figures.
        advice: what to do; empty if nothing is to be done.
    """

    subject: str
    verdict: FindingLevel
    detail: str
    advice: str = ""


def good(subject: str, detail: str) -> Finding:
    """All is well."""
    return Finding(subject, FindingLevel.GOOD, detail)


def warning(subject: str, detail: str, advice: str) -> Finding:
    """It works, with a disadvantage."""
    return Finding(subject, FindingLevel.WARNING, detail, advice)


def wrong(subject: str, detail: str, advice: str) -> Finding:
    """It does not work."""
    return Finding(subject, FindingLevel.WRONG, detail, advice)


def skipped(subject: str, detail: str, advice: str = "") -> Finding:
    """It was not examined."""
    return Finding(subject, FindingLevel.SKIPPED, detail, advice)


def first_wrong(findings: Sequence[Finding]) -> Finding | None:
    """The first thing that does not work; what comes after it may follow from it."""
    return next((finding for finding in findings if finding.verdict is FindingLevel.WRONG), None)


def report(findings: Sequence[Finding]) -> dict[str, Any]:
    """The finding for JSON."""
    first = first_wrong(findings)
    return {
        "findings": [asdict(finding) for finding in findings],
        "first_wrong": None if first is None else asdict(first),
    }
