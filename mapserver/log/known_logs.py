"""The logs of which a server has heard, and how far it is behind them."""

import time
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import AgentLog, PullSettings
from mapweave.mapserver.log.entry import Position
from mapweave.mapserver.log.store import Store

MOST_UNKNOWN = 1024
"""Logs of which nothing has come but beacons; of more, the one that is silent longest is forgotten."""


class Lag(NamedTuple):
    """How far the store is behind a robot.

    Attributes:
        missing: changes that are known of and not settled.
        seconds: for how long one of them is known of.
    """

    missing: int
    seconds: float


class KnownLogs(Mapping[MapId, AgentLog]):
    """The logs that the server knows, by their maps. One thread changes them."""

    def __init__(self) -> None:
        self._logs: dict[MapId, AgentLog] = {}
        self._unknown: dict[MapId, None] = {}

    def __getitem__(self, map_id: MapId) -> AgentLog:
        return self._logs[map_id]

    def __iter__(self) -> Iterator[MapId]:
        return iter(self._logs)

    def __len__(self) -> int:
        return len(self._logs)

    def restore(self, store: Store, positions: Mapping[MapId, Position], settings: PullSettings) -> None:
        """Add those of a store, as far as they are settled."""
        for map_id, (log_id, watermark) in sorted(positions.items()):
            agent_log = AgentLog(map_id, log_id, settings, watermark, watermark)
            agent_log.refusals = tuple(store.refusals(map_id))
            agent_log.damaged, agent_log.unverified = store.damaged(map_id), store.unverified(map_id)
            self.add(agent_log)

    def add(self, agent_log: AgentLog) -> None:
        """Add a log, or put it in the place of another of the same name."""
        self._logs[agent_log.map] = agent_log

    def heard(self, agent_log: AgentLog) -> MapId | None:
        """Something of a log has come. Names alone fill no memory.

        Returns:
            A log that is forgotten for it: one that was only heard of, long ago.
        """
        self._unknown.pop(agent_log.map, None)
        if agent_log.watermark > 0:
            return None
        self._unknown[agent_log.map] = None
        if len(self._unknown) <= MOST_UNKNOWN:
            return None
        oldest = next(known for known in self._unknown if not self._logs[known].pulling)
        del self._unknown[oldest], self._logs[oldest]
        return oldest

    def lags(self) -> dict[str, Lag]:
        """How far the store is behind each robot, by name; from any thread."""
        now, lags = time.monotonic(), dict[str, Lag]()
        for agent_log in list(self._logs.values()):
            before = lags.get(agent_log.map.agent, Lag(0, 0.0))
            missing = max(agent_log.newest - agent_log.watermark, 0)
            lags[agent_log.map.agent] = Lag(before.missing + missing, max(before.seconds, agent_log.lag(now)))
        return lags
