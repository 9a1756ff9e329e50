"""Which log is asked for a missing piece next, so that no robot keeps others waiting."""

from collections.abc import Iterator

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import NEVER, AgentLog

AT_ONCE = 32
"""Robots that are asked at once, each for one piece: a fleet that connects again is asked a few hundred a
second, at a tenth of a second each on busy machines. A thread and at most a megabyte for each."""
SILENT_AT_ONCE = 16
"""Of these, robots that did not answer last time, or never yet: each holds its place until the time-out."""


class PullSchedule:
    """Logs that lack something. Robots that answer go first, and take turns."""

    def __init__(self) -> None:
        self._lacking: dict[MapId, AgentLog] = {}
        self._asked: dict[str, bool] = {}
        self._answering: set[str] = set()
        self._turns: dict[str, int] = {}

    def note(self, agent_log: AgentLog, now: float) -> None:
        """Something has become of a log."""
        agent_log.plan(now)
        if agent_log.complete:
            self.forget(agent_log.map)
        else:
            self._lacking[agent_log.map] = agent_log

    def forget(self, map_id: MapId) -> None:
        """A log is complete, or gone."""
        self._lacking.pop(map_id, None)

    def answers(self, agent: str) -> None:
        """A robot has delivered something."""
        self._answering.add(agent)

    def due(self, now: float) -> float:
        """When the next log may be asked for, if nothing changes before; never earlier than now."""
        return max(min(map(_at, self._free()), default=NEVER), now)

    def next(self, now: float) -> AgentLog | None:
        """A log that is to be asked for now, if there is one."""
        due = [agent_log for agent_log in self._free() if _at(agent_log) <= now]
        return min(due, key=self._rank, default=None)

    def asks(self, agent: str) -> None:
        """A robot is asked."""
        self._asked[agent] = agent not in self._answering
        self._turns[agent] = max(self._turns.values(), default=0) + 1

    def ends(self, agent: str, *, answered: bool) -> None:
        """A robot has answered, or its time is over."""
        self._asked.pop(agent, None)
        (self._answering.add if answered else self._answering.discard)(agent)
        if not any(map_id.agent == agent for map_id in self._lacking):
            self._turns.pop(agent, None)

    def _free(self) -> Iterator[AgentLog]:
        if len(self._asked) >= AT_ONCE:
            return
        silent_too = sum(self._asked.values()) < SILENT_AT_ONCE
        for agent_log in self._lacking.values():
            agent = agent_log.map.agent
            if agent not in self._asked and (silent_too or agent in self._answering):
                yield agent_log

    def _rank(self, agent_log: AgentLog) -> tuple[bool, int, float]:
        agent = agent_log.map.agent
        return agent not in self._answering, self._turns.get(agent, 0), agent_log.pull_at


def _at(agent_log: AgentLog) -> float:
    return max(agent_log.pull_at, agent_log.resting_until)
