"""The figures of a demo: `report.json`, and lines for people."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from rich.table import Table

from mapweave.scenarios.run import TrialResult


@dataclass
class Relocalization:
    """How the lost robot was found.

    Attributes:
        found: whether it was localized.
        error_m: position error in the frame of the node that was named.
        error_deg: heading error likewise.
        seconds: simulated, from the kidnapping to the answer.
        node: that was named.
    """

    found: bool = False
    error_m: float | None = None
    error_deg: float | None = None
    seconds: float | None = None
    node: str = ""


@dataclass
class Goal:
    """How the lost robot arrived.

    Attributes:
        reached: whether it reports that it is parked, and the truth agrees to 5 cm and 3 degrees.
        error_m: distance from the pose where the goal's image was taken.
        error_deg: heading error likewise.
        mapped_by: whose node the goal is.
        edges: of the route.
        node: the goal.
        seconds: simulated, from the kidnapping to the end.
    """

    reached: bool = False
    error_m: float | None = None
    error_deg: float | None = None
    mapped_by: str = ""
    edges: int = 0
    node: str = ""
    seconds: float | None = None


@dataclass
class Report:
    """Everything that a demo measured. Truth is used for these figures and for nothing else."""

    seed: int
    agents: list[str]
    nodes: dict[str, int] = field(default_factory=dict)
    bytes_per_node: float = 0.0
    components: int = 0
    links: int = 0
    false_links: int = 0
    merged_ate_m: float | None = None
    relocalization: Relocalization = field(default_factory=Relocalization)
    goal: Goal = field(default_factory=Goal)
    collisions: int = 0
    lost_robot: str = ""
    put_down_in: str = ""
    notes: list[str] = field(default_factory=list)
    wall_s: float = 0.0
    sim_s: float = 0.0
    real_time_factor: float = 0.0

    @staticmethod
    def of(trial: TrialResult) -> Report:
        """The report on a trial of the scenario `demo`."""
        recording, figures = trial.recording, trial.figures
        report = Report(
            seed=recording.seed,
            agents=list(recording.robots),
            nodes={name: robot.nodes for name, robot in figures.robots.items()},
            bytes_per_node=round(figures.bytes_per_node or 0.0, 1),
            components=figures.components,
            links=figures.links,
            false_links=figures.false_links,
            merged_ate_m=_rounded(figures.merged_ate_m, 4),
            collisions=figures.collisions,
            notes=[moment.text for moment in recording.moments if moment.trouble],
            wall_s=round(recording.wall["whole"], 2),
            sim_s=round(recording.sim_s, 1),
        )
        report.real_time_factor = round(report.sim_s / report.wall_s, 3)
        if recording.lost:
            lost = recording.lost[-1]
            report.lost_robot, report.put_down_in = lost.robot, lost.room
            report.relocalization = Relocalization(
                found=lost.fix is not None,
                error_m=_rounded(figures.found_error_m, 4),
                error_deg=_rounded(figures.found_error_deg, 3),
                seconds=_rounded(figures.found_s, 1),
                node="" if lost.fix is None else str(lost.fix.node),
            )
            report.goal = Goal(
                reached=bool(figures.reached),
                error_m=_rounded(figures.goal_error_m, 4),
                error_deg=_rounded(figures.goal_error_deg, 3),
                mapped_by="" if lost.goal is None else lost.goal.agent,
                edges=max(lost.legs - 1, 0),
                node="" if lost.goal is None else str(lost.goal),
                seconds=_rounded(figures.goal_s, 1),
            )
        return report

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON."""
        return asdict(self)

    def lines(self) -> list[tuple[str, str]]:
        """Name and text of each line of the summary."""
        relocalization, goal = self.relocalization, self.goal
        where = f"{self.lost_robot} was put down in {self.put_down_in}: " if self.lost_robot else ""
        lines = [
            ("nodes", ", ".join(f"{name} {count}" for name, count in self.nodes.items())),
            ("bytes a node", f"{self.bytes_per_node:.0f} on the wire, edges included"),
            ("merged map", f"{self.components} component(s), {self.links} links, {self.false_links} false"),
            ("merged ATE", _metres(self.merged_ate_m)),
            (
                "relocalization",
                where
                + _outcome(
                    relocalization.found,
                    relocalization.error_m,
                    relocalization.error_deg,
                    relocalization.seconds,
                ),
            ),
            (
                "goal",
                f"node {goal.node} over {goal.edges} edges: "
                + _outcome(goal.reached, goal.error_m, goal.error_deg, goal.seconds),
            ),
            ("collisions", str(self.collisions)),
            (
                "time",
                f"{self.sim_s:.0f} s simulated in {self.wall_s:.0f} s, "
                f"{self.real_time_factor:.1f} x real time",
            ),
        ]
        return lines + [("note", note) for note in self.notes]


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} m"


def _outcome(good: bool, metres: float | None, degrees: float | None, seconds: float | None) -> str:
    if metres is None or degrees is None or seconds is None:
        return "no"
    return f"{'yes' if good else 'no'}, {metres:.3f} m and {degrees:.2f} deg off after {seconds:.0f} s"


def summary_table(report: Report) -> Table:
    """The figures of a demo for people."""
    table = Table(title="Three maps, one map, one lost robot found", show_header=False)
    table.add_column(justify="right", style="bold")
    table.add_column()
    for name, text in report.lines():
        table.add_row(name, text)
    return table
