"""Progress of a trial on the terminal."""

from __future__ import annotations

import time

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from mapweave.scenarios.scenario_runner import ScenarioRunner
from mapweave.terminal import EVERY, plain_or_terminal


class TerminalProgress:
    """A line for the trial and one for each robot; what happened stays above."""

    def __init__(self, name: str, robots: tuple[str, ...], events: int, quiet: bool) -> None:
        """Prepare; with `quiet` nothing is shown."""
        self._console = plain_or_terminal(quiet=quiet)
        self._said_at = 0.0
        self._progress = Progress(
            TextColumn("{task.description:>8}"), BarColumn(bar_width=24), TimeElapsedColumn(),
            TextColumn("{task.fields[doing]}"), console=self._console, transient=False,
        )  # fmt: skip
        self._whole = self._progress.add_task(name[:16], total=float(events), doing="starting")
        self._robots: dict[str, TaskID] = {
            robot: self._progress.add_task(robot, total=None, doing="starting") for robot in robots
        }
        self._printed = 0

    def __enter__(self) -> TerminalProgress:
        """Begin to show."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the terminal."""
        if self._console.is_terminal:
            self._progress.stop()

    def say(self, text: str) -> None:
        """One line that stays."""
        self._console.print(text)

    def stage(self, text: str) -> None:
        """Print an activity outside the scenario."""
        self._progress.update(self._whole, doing=text)
        if not self._console.is_terminal:
            self._console.print(text, highlight=False)

    def look(self, runner: ScenarioRunner) -> None:
        """Print the progress of the trial, and the activity of every robot."""
        for moment in runner.moments[self._printed :]:
            self._console.print(f"{moment.stamp_ns / 1e9:7.1f} s  {moment.text}", highlight=False)
        self._printed = len(runner.moments)
        doing = f"{runner.now:6.1f} s  {runner.doing}"
        if not self._console.is_terminal and time.monotonic() - self._said_at >= EVERY:
            nodes = ", ".join(
                f"{name} {report.status.nodes}" for name, report in sorted(runner.agents.items())
            )
            self._console.print(f" {doing}{nodes and f'; nodes: {nodes}'}", highlight=False)
            self._said_at = time.monotonic()
        self._progress.update(self._whole, completed=float(runner.done), doing=doing[:110])
        for robot, task in self._robots.items():
            report = runner.agents.get(robot)
            if report is None:
                self._progress.update(task, doing="not in reach")
                continue
            status = report.status
            detail = f", {status.detail}" if status.detail else ""
            self._progress.update(task, doing=f"{status.nodes:3d} nodes  {status.doing}{detail}"[:110])
