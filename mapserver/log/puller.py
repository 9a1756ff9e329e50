"""Asks agents for what is missing of their logs; a few threads wait for the answers."""

import itertools
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import msgspec

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.intake import Intakes
from mapweave.mapserver.log.pull_schedule import AT_ONCE, PullSchedule
from mapweave.mapserver.log.pulled import Pulled
from mapweave.wire.bus import Bus, Reply
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import LogRequest, StoredChange

log = logging.getLogger(__name__)

MOST_REPLIES = 4
"""To one question. A robot gives one, and what is left of it where it was started twice another."""


class Puller:
    """Pulls of one server.

    Attributes:
        schedule: which log is asked for next.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        intakes: Intakes,
        unmerged: Callable[[str], int],
        newest_change: Callable[[MapId, int], StoredChange | None],
        ask_timeout: float,
        answered: Callable[[Pulled], None],
    ) -> None:
        """Begin with nothing missing.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            intakes: how much is taken of each robot.
            unmerged: how many changes of a robot were passed on and wait.
            newest_change: up to a number of a log that is stored; called in one of the threads.
            ask_timeout: for a piece of a log, s.
            answered: called in one of the threads.
        """
        self.schedule = PullSchedule()
        self._bus, self._keys, self._intakes = bus, keys, intakes
        self._unmerged, self._timeout, self._answered = unmerged, ask_timeout, answered
        self._newest_change = newest_change
        self._threads = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="pull")

    def start(self) -> int:
        """Ask for what is due; returns for how many pieces."""
        count = 0
        while (agent_log := self.schedule.next(now := time.monotonic())) is not None:
            agent = agent_log.map.agent
            intake = self._intakes.of(agent)
            rows = intake.rows(self._unmerged(agent))
            asked = agent_log.missing(now, rows) if rows else None
            if asked is None:
                agent_log.pull_at = now + intake.pause()
                continue
            count += 1
            self.schedule.asks(agent)
            self._threads.submit(self._pull, agent_log, asked)
        return count

    def close(self) -> None:
        """Wait for the answers that are due, and ask for no more."""
        self._threads.shutdown(cancel_futures=True)

    def _pull(self, agent_log: AgentLog, asked: LogRequest) -> None:
        """Pull changes, in a thread of its own, because an agent may be slow."""
        replies: list[Reply] = []
        try:
            stored = self._newest_change(agent_log.map, asked.first - 1)
            asked = msgspec.structs.replace(asked, stored=stored)
            key = self._keys.log(agent_log.map)
            replies = self._bus.ask(key, asked.encode(), self._timeout, _after(MOST_REPLIES))
        except InvalidFile as error:  # what comes cannot be kept now either, and that is logged
            log.debug("%s", error)
        except Exception:  # without an end the robot would count as asked, and not be asked again
            log.exception("asking for %s failed", agent_log.map)
        self._answered(Pulled(agent_log, asked, replies))


def _after(most: int) -> Callable[[Reply], bool]:
    """Whether so many replies have come."""
    count = itertools.count(1)
    return lambda reply: next(count) >= most
