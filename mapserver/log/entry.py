"""Entries of the store, and its results: plain values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from mapweave.hybridmap.change import Change, EdgePut
from mapweave.hybridmap.edge_limits import unmeasurable
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId
from mapweave.wire.codec import decode_body, element_of, unwrap_body
from mapweave.wire.log_messages import Refusal


@dataclass(frozen=True, slots=True)
class ReceivedChange:
    """A change of a robot's log, encoded as it came and decoded.

    Attributes:
        sequence: its place in the log.
        message: the encoded change.
        change: the decoded change, or the reason why it is refused.
    """

    sequence: int
    message: bytes
    change: Change | str

    @staticmethod
    def read(map_id: MapId, sequence: int, message: bytes) -> ReceivedChange:
        """Decode a message that claims this place in this map's log."""
        try:
            own_sequence, stamp_ns, encoded = unwrap_body(message)
            body = decode_body(encoded)
        except InvalidMessage as error:
            return ReceivedChange(sequence, message, str(error))
        if (element_of(body).map, own_sequence) != (map_id, sequence):
            claim = f"{element_of(body).map} {own_sequence}"
            return ReceivedChange(sequence, message, f"change: {claim} came as {map_id} {sequence}")
        if isinstance(body, EdgePut) and (reason := unmeasurable(body.edge)):
            return ReceivedChange(sequence, message, reason)
        return ReceivedChange(sequence, message, Change(map_id, sequence, stamp_ns, body))


def words_of(refusal: Refusal) -> str:
    """Which change is refused, and why."""
    return f"change {refusal.sequence} is refused ({refusal.reason})"


@dataclass(frozen=True, slots=True)
class Applied:
    """Result of a batch.

    Attributes:
        changes: that are new, in order; they are on the disk.
        refusals: that were refused now, in order; that is on the disk too.
        watermark: every change up to this one is settled.
        before: every change up to this one was settled already; by another server, if this one did not know.
    """

    changes: tuple[Change, ...]
    refusals: tuple[Refusal, ...]
    watermark: int
    before: int = 0


class Position(NamedTuple):
    """How far a log has come.

    Attributes:
        log_id: which log it is.
        watermark: every change up to this one is settled.
    """

    log_id: int
    watermark: int


@dataclass(frozen=True, slots=True)
class Traffic:
    """Wire bytes of a map, each change counted once.

    Attributes:
        nodes: distinct nodes that were put.
        node_puts: messages that put a node.
        node_bytes: in these.
        edge_puts: messages that put an edge.
        edge_bytes: in these.
    """

    nodes: int
    node_puts: int
    node_bytes: int
    edge_puts: int
    edge_bytes: int

    @property
    def payload_bytes(self) -> int:
        """Bytes of payload in all of these."""
        return self.node_bytes + self.edge_bytes
