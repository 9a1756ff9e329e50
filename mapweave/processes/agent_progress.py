"""Progress of an agent on the terminal."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console

from mapweave.agent.observation import Observation
from mapweave.agent.pipeline import Step
from mapweave.terminal import Bar, EventLog


class AgentProgress:
    """Progress of a run: with a bar where the end is known, else a line when something changes."""

    def __init__(self, console: Console, name: str, total: int | None) -> None:
        """Show the progress of an agent.

        Args:
            console: where.
            name: of the agent.
            total: observations that will come, if that is known.
        """
        self._name, self._say = name, EventLog(console)
        self._bar = None if total is None else Bar(console, name, total)
        self._last_line = ""

    def __enter__(self) -> AgentProgress:
        """Begin."""
        if self._bar is not None:
            self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End."""
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)

    def __call__(self, observation: Observation, step: Step) -> None:
        """Show a tick."""
        status = step.status
        if self._bar is not None:
            self._bar.advance(1, f"{status.nodes} nodes, {status.detail}")
        elif status.doing != self._last_line:
            self._last_line = status.doing
            self._say(f"{self._name}: {status.doing} ({status.nodes} nodes) {status.detail}")
