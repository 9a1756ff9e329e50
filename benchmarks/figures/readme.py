"""The table of figures in README.md: a few rows of docs/figures.md, of the same stored results."""

from __future__ import annotations

import re
from collections.abc import Mapping

from benchmarks.figures.page import filled
from benchmarks.figures.questions import Row
from benchmarks.figures.results import StoredResult
from mapweave.hybridmap.errors import InvalidValue

HEAD = "| what | figure |\n|---|---|\n"
TABLE = re.compile(re.escape(HEAD) + r"(?:\|.*\n)*")
ROWS = (
    Row("a node with 150 landmarks on the wire", "{bytes_per_node:.0f} bytes", "landmarks"),
    Row(
        "correct matches kept, compared with full SIFT (512 bytes per descriptor)",
        "{inliers_ratio_to_float_sift:.1%}",
        "landmarks",
    ),
    Row(
        "mapping filter: error relative to a batch optimum, median",
        "{rmse_ratio_to_batch_median:.3f}",
        "ekf",
    ),
    Row("mapping filter: a step with 30 landmarks", "{step_ms_n30:.2f} ms", "ekf_speed"),
    Row(
        "servo on an exact unicycle: parked within 1 cm and 1 degree without losing its landmarks",
        "{success:.0%} of {trials}",
        "servo",
    ),
    Row(
        "parking with camera and filters within 1 cm and 1 degree; median error",
        "{success:.0%} of {starts}; {error_m_median:.1m} mm",
        "parking",
    ),
    Row(
        "navigation to a place at least 4 edges away, from an unmapped pose: there within 5 cm; median error",
        "{success:.0%} of {runs}; {goal_error_m_median:.1m} mm",
        "navigate",
    ),
    Row(
        "relocalization: recall of one view among 100 000 places",
        "{sizes/100000/recall_at_1:.0%}",
        "relocalize",
    ),
    Row(
        "relocalization: views of unknown buildings, and of twin rooms, that get a place",
        "{sizes/100000/wrong/nowhere:.1%}, {sizes/100000/wrong/twins:.1%}",
        "relocalize",
    ),
    Row(
        "merging: synthetic fleets with 80 % false links that are as good as with the true links known, "
        "and that are joined falsely",
        "{fleets/all rules/80/good}, {fleets/all rules/80/joined_falsely}",
        "rules_fleets",
    ),
    Row(
        "a real street (KITTI odometry 03), cut into two robots: maps, false links, error",
        "{components}, {false_links} of {links}, {merged_ate_m:.2f} m",
        "kitti_two",
    ),
)


def with_table(text: str, results: Mapping[str, StoredResult]) -> str:
    """README.md with the table of stored results.

    Raises:
        InvalidValue: there is not one table, or a figure is missing.
    """
    rows = "".join(f"| {row.what} | {filled(row.figure, results[row.source].figures)} |\n" for row in ROWS)
    made, tables = TABLE.subn(lambda _: HEAD + rows, text)
    if tables != 1:
        raise InvalidValue(f"README.md has {tables} tables of figures instead of one")
    return made
