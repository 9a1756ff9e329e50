"""What a robot answered when it was asked for a piece of its log."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.wire.bus import Reply
from mapweave.wire.dispatch import Failures
from mapweave.wire.log_messages import LogAnswer, LogRequest

log = logging.getLogger(__name__)

Row = tuple[int, bytes]
"""Sequence number and encoded change."""
AT_ONE_TURN = 16
"""Pulled changes of a robot that are committed at one turn; the others wait for its next."""


@dataclass(frozen=True, slots=True)
class PulledChanges:
    """Changes of a log that wait for their turn.

    Attributes:
        log: whose.
        rows: the changes, in order.
        covered: the robot has nothing else up to here; 0 if no answer is of use.
    """

    log: AgentLog
    rows: tuple[Row, ...]
    covered: int

    @property
    def now(self) -> PulledChanges:
        """What is committed at the next turn."""
        rows, later = self.rows[:AT_ONE_TURN], self.rows[AT_ONE_TURN:]
        return PulledChanges(self.log, rows, later[0][0] - 1 if later else self.covered)

    @property
    def later(self) -> PulledChanges | None:
        """What waits for a later turn; None if nothing does."""
        later = self.rows[AT_ONE_TURN:]
        return PulledChanges(self.log, later, self.covered) if later else None


@dataclass(frozen=True, slots=True)
class Pulled:
    """Replies to a question for a piece of a log."""

    log: AgentLog
    asked: LogRequest
    replies: list[Reply]

    def piece(self, failures: Failures) -> tuple[PulledChanges, int]:
        """The changes that came, and how many replies did not decode.

        Args:
            failures: says which of the replies that are none are logged.
        """
        asked, agent_log, damaged = self.asked, self.log, 0
        for reply in self.replies:
            if reply.error:
                if (also := failures.count_of(agent_log.map.agent)) is not None:
                    log.info(
                        "%s does not give %s from %d: %s%s",
                        agent_log.map.agent, agent_log.map, asked.first, reply.error, also,
                    )  # fmt: skip
                continue
            try:
                answer = LogAnswer.decode(reply.payload)
            except InvalidMessage as error:
                damaged += 1
                if (also := failures.count_of(agent_log.map.agent)) is not None:
                    log.warning("%s from %d: %s%s", agent_log.map, asked.first, error, also)
                if asked.first == asked.last:
                    # It was asked for alone and does not fit into a message.
                    return PulledChanges(agent_log, ((asked.first, b""),), asked.first), damaged
                agent_log.chunk = max(1, (asked.last - asked.first + 1) // 4)
                continue
            if answer.log_id == agent_log.log_id and answer.first == asked.first:
                rows = tuple(row for row in answer.changes if row[0] <= asked.last)
                return PulledChanges(agent_log, rows, min(answer.covered, asked.last)), damaged
        return PulledChanges(agent_log, (), 0), damaged


class Pieces:
    """Pieces of logs of which a part is committed in this turn; one a log."""

    def __init__(self) -> None:
        self._pieces: dict[MapId, PulledChanges] = {}

    def put(self, piece: PulledChanges) -> None:
        """A piece whose turn has come."""
        self._pieces[piece.log.map] = piece

    def now(self, agent_log: AgentLog) -> PulledChanges | None:
        """What is committed of a log at this turn; None if nothing of it was pulled that is new."""
        piece = self._pieces.get(agent_log.map)
        if piece is None or piece.log is not agent_log or piece.now.covered <= agent_log.watermark:
            return None
        return piece.now

    def end(self, agent_log: AgentLog, now: float) -> PulledChanges | None:
        """The turn of a log is over; returns what waits for its next, if anything."""
        piece = self._pieces.pop(agent_log.map, None)
        if piece is None or piece.log is not agent_log:
            return None
        gained = agent_log.watermark >= piece.now.covered
        if gained and piece.later is not None:
            return piece.later
        agent_log.pulled(now, gained=gained)
        return None
