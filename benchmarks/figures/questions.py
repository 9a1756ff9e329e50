"""The questions of docs/figures.md, and from which results they are answered.

No number of a measurement stands here: `{path/of/keys:format}` is filled in from a result.
"""

from __future__ import annotations

from dataclasses import dataclass

INTRODUCTION = (
    "`python -m benchmarks.figures` writes this page from the results in [figures/](figures/); with `--run NAME` it "
    "measures first. No number is written by hand. *Asked* is what the project wants to hold. Seeds from 700 on "
    "were used for nothing before."
)


@dataclass(frozen=True)
class Row:
    """One figure, or a few of one kind.

    Attributes:
        what: is measured.
        figure: template.
        source: name of the result.
        asked: value, empty where none is.
    """

    what: str
    figure: str
    source: str
    asked: str = ""


@dataclass(frozen=True)
class Question:
    """A table.

    Attributes:
        title: of the section.
        rows: of the table.
        words: before the table, empty where none are needed.
    """

    title: str
    rows: tuple[Row, ...]
    words: str = ""


@dataclass(frozen=True)
class Rule:
    """A rule that rejects links, answers or frames.

    Attributes:
        name: of the rule.
        file: where it stands.
        fails: templates of what fails without it, each with the name of the result.
    """

    name: str
    file: str
    fails: tuple[tuple[str, str], ...]


QUESTIONS = (
    Question(
        "How accurate and fast are the filters?",
        (
            Row(
                "mapping filter: error over that of a batch optimum, median and 90th percentile",
                "{rmse_ratio_to_batch_median:.3f}, {rmse_ratio_to_batch_p90:.3f}",
                "ekf",
                "median at most 1.02",
            ),
            Row(
                "the same with 30 % wrong tracks, over that without any",
                "{outlier30_ratio:.3f}, {outlier30_ratio_p90:.3f}",
                "ekf",
            ),
            Row(
                "mapping filter: normalised squared error of poses and landmarks (3 is ideal)",
                "{nees_pose:.2f}, {nees_landmark:.2f}",
                "ekf",
            ),
            Row(
                "localization filter: starts up to 1 m and 1 rad wrong that converge",
                "{localization_converged:.1%}",
                "ekf",
            ),
            Row(
                "mapping filter, a step with 30 landmarks: as robots run it, with FilterPy's algorithm, FilterPy",
                "{step_ms_n30:.2f}, {step_ms_n30_plain:.2f}, {filterpy_step_ms_n30:.2f} ms",
                "ekf_speed",
                "at most 0.5 ms",
            ),
            Row(
                "the same with 100 landmarks",
                "{step_ms_n100:.1f}, {step_ms_n100_plain:.1f}, {filterpy_step_ms_n100:.1f} ms",
                "ekf_speed",
            ),
        ),
    ),
    Question(
        "Does a robot park, arrive and explore?",
        (
            Row(
                "servo on an exact unicycle: parked within 1 cm and 1 degree, never fewer than 4 landmarks in view",
                "{success:.0%} of {trials}",
                "servo",
                "100 %",
            ),
            Row(
                "its way over the shortest that keeps the landmarks in view, median",
                "{path_ratio_median:.2f}",
                "servo",
            ),
            Row(
                "the same with the switching of the 2004 paper, and with a pursuit that ignores the field of view",
                "{rivals/greedy_2004/success:.0%}, {rivals/pursuit_without_fov/success:.0%}",
                "servo",
            ),
        ),
    ),
    Question(
        "Are maps merged rightly?",
        (
            Row(
                "KITTI odometry 03 cut into two robots: components, false links, error",
                "{components}, {false_links} of {links}, {merged_ate_m:.2f} m",
                "kitti_two",
                "one map",
            ),
        ),
    ),
)

RULES: tuple[Rule, ...] = ()
