"""A trial's report as a page that can be read anywhere: Markdown."""

from collections.abc import Mapping, Sequence

from mapweave.hybridmap.ids import MapId
from mapweave.scenarios.expectations import ExpectationResult
from mapweave.scenarios.figures import Figures, as_text
from mapweave.scenarios.recording import TrialRecording

GROUPS = {
    "Merged map": (
        "components", "maps", "nodes", "edges", "false_edges", "loops", "false_loops",
        "longest_loop_m", "explored_share", "links", "false_links",
        "link_precision", "link_recall", "merged_ate_m",
    ),
    "Trajectories, by evo (the worst of all maps)": ("trajectory_ate_m", "rpe_m", "rpe_deg"),
    "Driving": (
        "collisions", "found", "found_error_m", "found_error_deg", "found_s", "reached", "goal_error_m",
        "goal_error_deg", "goal_s",
    ),
    "Lies of a robot": (
        "lies", "lies_not_contained", "lies_not_named", "lies_moved_m", "lies_answers_changed",
    ),
    "Network and disks": (
        "troubles", "unsaved_changes", "recovery_s", "bytes_per_node", "map_bytes_per_robot_minute",
        "wire_bytes_per_robot_minute", "map_hash",
    ),
    "Time": ("sim_s", "wall_s", "real_time_factor"),
}  # fmt: skip
"""Every figure, in the order of the page."""


def report_page(
    recording: TrialRecording,
    figures: Figures,
    verdicts: Sequence[ExpectationResult],
    files: Mapping[MapId, tuple[str, str]],
    film: bool,
) -> str:
    """The page.

    Args:
        recording: what was left behind.
        figures: what it measured.
        verdicts: what came of the expectations.
        files: names of the truth's and the estimate's trajectory file of each map that was driven.
        film: whether there is a film next to it.
    """
    passed = all(v.good for v in verdicts)
    lines = [f"# {recording.scenario}, seed {recording.seed}: {'passed' if passed else 'FAILED'}", ""]
    if verdicts:
        judged = [(v.name, v.wanted, _measured(v), "yes" if v.good else "**no**") for v in verdicts]
        lines += _table(("expectation", "wanted", "measured", "met"), judged)
    else:
        lines += ["The scenario expects nothing in particular.", ""]
    lines += ["![The merged map over the true floor plan](map.png)", ""]
    lines += [
        "Dots with arrows are places with a view, at their merged pose after one alignment a component.",
        "",
    ]
    lines += ["![Position error over time](errors.png)", ""]
    if film:
        lines += ["[Film](film.webm): from above, next to the cameras.", ""]
    lines += [
        "## Figures",
        "",
        "A dash: does not apply, or was not measured. What each one is: `mapweave/scenarios/figures.py`.",
        "",
    ]
    for group, names in GROUPS.items():
        lines += [f"### {group}", ""]
        lines += _table(("figure", "value"), [(name, as_text(getattr(figures, name))) for name in names])
    lines += ["### Robots", "", *_robots(figures)]
    if recording.wall:
        lines += ["### Where the time went", ""]
        lines += _table(("part", "wall s"), [(part, f"{s:.1f}") for part, s in recording.wall.items()])
    lines += ["## What happened", ""]
    if recording.moments:
        rows = [(str(k + 1), f"{m.stamp_ns / 1e9:.1f}", m.text) for k, m in enumerate(recording.moments)]
        lines += _table(("", "simulated s", "what"), rows)
    else:
        lines += ["Nothing out of the ordinary.", ""]
    if files:
        lines += ["## The same figures by evo", ""]
        lines += ["`pip install evo`, then, in this folder:", "", "```"]
        for truth, estimate in files.values():
            lines.append(f"evo_ape tum {truth} {estimate} --align")
            rpe = f"evo_rpe tum {truth} {estimate} --delta 1 --delta_unit m --pairs_from_reference"
            lines += [rpe, f"{rpe} --pose_relation angle_deg"]
        lines += ["```", ""]
    lines += ["## Again", ""]
    lines += ["```", f"mapweave sim run scenario.toml --seed {recording.seed}", "```", ""]
    return "\n".join(lines)


def _robots(figures: Figures) -> list[str]:
    names = ("maps", "nodes", "trajectory_ate_m", "rpe_m", "rpe_deg", "collisions", "map_bytes", "wire_bytes",
             "unsaved_changes")  # fmt: skip
    rows = []
    for robot in sorted(figures.robots):
        share = figures.robots[robot]
        rows.append((robot, *(as_text(getattr(share, name)) for name in names), share.map_hash[:12]))
    return _table(("robot", *names, "map_hash"), rows)


def _measured(verdict: ExpectationResult) -> str:
    return "not measured" if verdict.measured is None else as_text(verdict.measured)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table and an empty line; a bar in a text must not end its cell."""
    escaped = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows]
    return [_row(header), _row(["---"] * len(header)), *(_row(row) for row in escaped), ""]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
