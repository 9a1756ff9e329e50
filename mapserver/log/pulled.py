"""What a robot answered when it was asked for a piece of its log."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.wire.bus import Reply
from mapweave.wire.log_messages import LogAnswer, LogRequest

log = logging.getLogger(__name__)

Row = tuple[int, bytes]
"""Sequence number and encoded change."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Changes of a log that wait for their turn.

    Attributes:
        log: whose.
        rows: the changes, in order.
        covered: the robot has nothing else up to here; 0 if no answer is of use.
    """

    log: AgentLog
    rows: tuple[Row, ...]
    covered: int


@dataclass(frozen=True, slots=True)
class Pulled:
    """Replies to a question for a piece of a log."""

    log: AgentLog
    asked: LogRequest
    replies: list[Reply]

    def piece(self) -> tuple[Piece, int]:
        """The changes that came, and how many replies did not decode."""
        asked, agent_log, damaged = self.asked, self.log, 0
        for reply in self.replies:
            if reply.error:
                log.info(
                    "%s does not give %s from %d: %s",
                    agent_log.map.agent, agent_log.map, asked.first, reply.error,
                )  # fmt: skip
                continue
            try:
                answer = LogAnswer.decode(reply.payload)
            except InvalidMessage as error:
                damaged += 1
                log.warning("%s from %d: %s", agent_log.map, asked.first, error)
                if asked.first == asked.last:
                    # It was asked for alone and does not fit into a message.
                    return Piece(agent_log, ((asked.first, b""),), asked.first), damaged
                agent_log.chunk = max(1, (asked.last - asked.first + 1) // 4)
                continue
            if answer.log_id == agent_log.log_id and answer.first == asked.first:
                rows = tuple(row for row in answer.changes if row[0] <= asked.last)
                return Piece(agent_log, rows, min(answer.covered, asked.last)), damaged
        return Piece(agent_log, (), 0), damaged
