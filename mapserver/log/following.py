"""Changes that this server did not take itself: another one wrote them to the store that they share."""

import logging
import time
from collections.abc import Callable, Iterable
from itertools import takewhile

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import AgentLog, PullSettings
from mapweave.mapserver.log.entry import Applied, Position, words_of
from mapweave.mapserver.log.intake import Intakes
from mapweave.mapserver.log.known_logs import KnownLogs
from mapweave.mapserver.log.pull_schedule import PullSchedule
from mapweave.mapserver.log.store import News, Store

log = logging.getLogger(__name__)


def unseen(store: Store, agent_log: AgentLog, applied: Applied) -> Iterable[Change]:
    """The changes behind the watermark that this server knew, up to the one that is settled now."""
    if applied.before <= agent_log.watermark:
        return applied.changes
    return up_to(applied.watermark, store.replay(agent_log.map, agent_log.watermark))


def settled(store: Store, map_id: MapId, position: Position) -> Iterable[Change]:
    """A log from its beginning; of a store that servers share up to a position, since another may add to it.

    Where damage cost the position, what is good of the log is behind it.
    """
    changes = store.replay(map_id)
    return up_to(position.watermark, changes) if store.shared else changes


def up_to(watermark: int, changes: Iterable[Change]) -> Iterable[Change]:
    """Those that are settled: another server may add more while they are read."""
    return takewhile(lambda change: change.sequence <= watermark, changes)


class Follower:
    """Goes on where other servers have brought the logs."""

    def __init__(
        self,
        store: Store,
        logs: KnownLogs,
        intakes: Intakes,
        pulls: PullSchedule,
        settings: PullSettings,
        pass_on: Callable[[Iterable[Change]], None],
        note_refusal: Callable[[MapId, str], None],
    ) -> None:
        """Begin with nothing new.

        Args:
            store: stays the caller's.
            logs: of which this server has heard.
            intakes: what is kept of each robot.
            pulls: which logs lack something.
            settings: of logs that are new.
            pass_on: called with changes of a log, in order.
            note_refusal: called for a map of which a change was refused, with the reason.
        """
        self._store, self._logs, self._intakes, self._pulls = store, logs, intakes, pulls
        self._settings, self._pass_on, self._note_refusal = settings, pass_on, note_refusal

    def take(self, news: News) -> None:
        """Pass on what other servers have written, and pull what the store has lost."""
        try:
            positions = self._store.positions(news.maps)
            if news.maps is None:
                lost = [one for one in self._logs.values() if one.watermark and one.map not in positions]
                positions |= {one.map: Position(one.log_id, 0) for one in lost}
            for map_id, (log_id, watermark) in positions.items():
                agent_log = self._logs.get(map_id)
                if agent_log is not None and agent_log.log_id == log_id and watermark < agent_log.watermark:
                    self._go_back(agent_log, watermark)
                if agent_log is None or (agent_log.log_id != log_id and agent_log.watermark == 0):
                    agent_log = AgentLog(map_id, log_id, self._settings)
                    self._logs.add(agent_log)
                if agent_log.log_id != log_id or watermark <= agent_log.watermark:
                    continue
                self._intakes.of(map_id.agent).recount(map_id)
                for change in up_to(watermark, self._store.replay(map_id, agent_log.watermark)):
                    self._pass_on([change])
                    agent_log.settled(Applied((), (), change.sequence))
                agent_log.settled(Applied((), (), watermark))
                agent_log.refusals = tuple(self._store.refusals(map_id))
                for refusal in agent_log.refusals[:1]:
                    self._note_refusal(map_id, words_of(refusal))
                self._pulls.answers(map_id.agent)
                self._pulls.note(agent_log, time.monotonic())
        except InvalidFile as error:
            # With the next news everything is looked at.
            log.warning("%s", error)

    def _go_back(self, agent_log: AgentLog, watermark: int) -> None:
        """The store has less of a log than it had: a standby that was behind is the primary now.

        Its robot knows the rest to be acknowledged, and says nothing more of it while this server runs.
        """
        map_id, had = agent_log.map, agent_log.watermark
        log.warning("%s %d to %d are gone from the store: they are pulled again", map_id, watermark + 1, had)
        self._store.doubt(map_id, had)
        agent_log.unverified = self._store.unverified(map_id)
        agent_log.go_back(watermark, time.monotonic())
        self._intakes.of(map_id.agent).recount(map_id)
        self._pulls.note(agent_log, time.monotonic())
