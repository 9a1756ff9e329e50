"""Progress of an agent on the terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType

from rich.console import Console

from mapweave.agent.observation import Observation
from mapweave.agent.pipeline import TickResult
from mapweave.hybridmap.counted import counted
from mapweave.terminal import Bar, EventLog

BURST, A_SECOND = 20.0, 1.0
"""Lines that may come at once, and how many a second later: a camera that flickers changes what a robot does
ten times a second, and a log fills a card."""


class AgentProgress:
    """Progress of a run: with a bar where the end is known, else a line when something changes."""

    def __init__(
        self, console: Console, name: str, total: int | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Show the progress of an agent.

        Args:
            console: where.
            name: of the agent.
            total: observations that will come, if that is known.
            clock: s, only grows.
        """
        self._name, self._say = name, EventLog(console)
        self._bar = None if total is None else Bar(console, name, total)
        self._said = self._doing = ""
        self._changes = 0
        self._clock, self._at, self._credit = clock, clock(), BURST

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

    def __call__(self, observation: Observation, step: TickResult) -> None:
        """Show a tick."""
        status = step.status
        if self._bar is not None:
            self._bar.advance(1, f"{counted(status.nodes, 'node')}, {status.detail}")
            return
        self._changes += status.doing != self._doing
        self._doing = status.doing
        if status.doing != self._said and self._may_say():
            also = f" ({self._changes - 1} changes before are left out)" if self._changes > 1 else ""
            self._said, self._changes = status.doing, 0
            self._say(f"{self._name}: {status.doing} ({counted(status.nodes, 'node')}) {status.detail}{also}")

    def _may_say(self) -> bool:
        """Whether there have not been too many lines recently; takes one of those that may come."""
        now = self._clock()
        self._credit = min(self._credit + A_SECOND * (now - self._at), BURST)
        self._at = now
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True
