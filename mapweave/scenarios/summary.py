"""What came of a trial, for people."""

from rich.table import Table
from rich.text import Text

from mapweave.scenarios.figures import as_text
from mapweave.scenarios.scenario import Scenario
from mapweave.scenarios.score import TrialResult

SHOWN = (
    "components", "maps", "nodes", "links", "false_links", "false_edges", "merged_ate_m", "trajectory_ate_m",
    "rpe_m", "found", "found_error_m", "reached", "goal_error_m", "goal_error_deg", "collisions",
    "unsaved_changes", "troubles", "explored_share",
    "longest_loop_m", "recovery_s", "bytes_per_node", "wire_bytes_per_robot_minute", "sim_s", "wall_s",
    "real_time_factor",
)  # fmt: skip
"""Of the figures; all of them are in figures.json."""


def summary_table(scenario: Scenario, seed: int, trial: TrialResult) -> Table:
    """Verdicts first, then the figures that were measured."""
    verdict = Text("passed", "green") if trial.passed else Text("failed", "red")
    table = Table(title=Text(f"{scenario.name}, seed {seed}: ") + verdict, show_header=False)
    table.add_column(justify="right", style="bold")
    table.add_column()
    judged = {row.name: row for row in trial.verdicts}
    for row in trial.verdicts:
        colour = "green" if row.good else "red"
        words = Text("as wanted" if row.good else "NOT as wanted", colour)
        table.add_row(row.name, words + Text(f": {row}"))
    for name in SHOWN:
        value = getattr(trial.figures, name)
        if name not in judged and value is not None:
            table.add_row(name, as_text(value))
    table.add_row("map hash", trial.figures.map_hash[:16])
    return table
