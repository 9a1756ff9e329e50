"""Progress of an agent on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

from mapweave.agent.observation import Observation
from mapweave.agent.pipeline import Step


class AgentProgress:
    """Progress of a run: with a bar where the end is known, else a line when something changes."""

    def __init__(self, console: Console, name: str, total: int | None) -> None:
        """Show the progress of an agent.

        Args:
            console: where.
            name: of the agent.
            total: observations that will come, if that is known.
        """
        self._console, self._name, self._total = console, name, total
        self._bar: Progress | None = None
        self._last_line = ""

    def __enter__(self) -> AgentProgress:
        """Begin."""
        if self._total is not None:
            self._bar = Progress(
                SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[detail]}"), console=self._console,
            )  # fmt: skip
            self._task = self._bar.add_task(self._name, total=self._total, detail="")
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End."""
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, observation: Observation, step: Step) -> None:
        """Show a tick."""
        status = step.status
        if self._bar is not None:
            self._bar.update(self._task, advance=1, detail=f"{status.nodes} nodes, {status.detail}")
        elif status.doing != self._last_line:
            self._last_line = status.doing
            self._console.print(f"{self._name}: {status.doing} ({status.nodes} nodes) {status.detail}")
