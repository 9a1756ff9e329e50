"""The small messages around a log: beacon, acknowledgement, range of a log, and flat records for people."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, ClassVar, Self

import msgspec
from msgspec import Meta, field

from mapweave.hybridmap.agent_status import LONGEST_STATUS_PERIOD
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.limits import MAX_FLOAT, MAX_NUMBER, Key, Name, Number
from mapweave.wire.codec import MAX_CHANGE_BYTES
from mapweave.wire.packing import Limit, pack, unpack

MARK = struct.Struct("<QQ")
MAX_ROWS = 256
"""Changes in one answer for a range of a log."""

MAX_SERVERS = 64
"""Of a fleet. A limit for messages, as all here."""
MAX_REFUSALS = 16
"""In one acknowledgement, the newest."""
MAX_REASON = 300
"""Characters of why a change is refused."""
MAX_KEPT_NODES = 2048
"""Nodes in one question whether they were pruned."""
MAX_SMALL_BYTES = 65536
"""Of a message without changes."""
MAX_SAID = 1024
"""Characters of a text in a flat record."""

Scalar = bool | int | float | str
Id = Annotated[int, Meta(ge=0)]
"""Drawn by chance, below 2^64."""
Sequence = Annotated[int, Meta(ge=1, le=MAX_NUMBER)]


@dataclass(frozen=True, slots=True)
class Mark:
    """Attachment of a published change, so that a receiver can order it undecoded.

    Attributes:
        sequence: of the change.
        log_id: which log this is. Random, drawn when the log is begun: an agent that has lost its disk and
            counts from one again must not be confused with the one before.
    """

    sequence: int
    log_id: int

    def encode(self) -> bytes:
        """16 bytes: both as little-endian uint64."""
        return MARK.pack(self.sequence, self.log_id)

    @staticmethod
    def decode(data: bytes) -> Mark:
        """Read an attachment.

        Raises:
            InvalidMessage: it is none.
        """
        if len(data) != MARK.size:
            raise InvalidMessage(f"change: an attachment of {len(data)} bytes instead of {MARK.size}")
        sequence, log_id = MARK.unpack(data)
        if not 1 <= sequence <= MAX_NUMBER:
            raise InvalidMessage(f"change: sequence {sequence} is out of range")
        return Mark(sequence, log_id)


class StoredChange(msgspec.Struct, frozen=True, array_like=True):
    """A change that a server has stored of a log: its number, and the CRC-32 of its body."""

    sequence: Sequence
    crc: Annotated[int, Meta(ge=0, lt=2**32)]


class LogMessage(msgspec.Struct, frozen=True, omit_defaults=True):
    """Any of them."""

    limit: ClassVar[Limit] = Limit("message", MAX_SMALL_BYTES)

    def encode(self) -> bytes:
        """The message as bytes."""
        return pack(msgspec.to_builtins(self, builtin_types=(bytes,)))

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """The same back; raises InvalidMessage."""
        message: Self = unpack(data, cls, cls.limit)
        return message


class Head(LogMessage, frozen=True):
    """An agent's beacon.

    Attributes:
        log_id: see Mark.
        newest: sequence number of the newest change, 0 if there is none.
        acknowledged: watermark by server, as known to the agent. A server that has more acknowledges again.
    """

    limit = Limit("head", MAX_SMALL_BYTES)
    log_id: Id = field(name="l")
    newest: Number = field(name="q")
    acknowledged: Annotated[dict[Name, Number], Meta(max_length=MAX_SERVERS)] = field(
        name="a", default_factory=dict
    )


class Refusal(msgspec.Struct, frozen=True, array_like=True):
    """A change that a server could not take, and why. Sequence 0: the whole log."""

    sequence: Number
    reason: Annotated[str, Meta(max_length=MAX_REASON)]


class Ack(LogMessage, frozen=True):
    """What a server has on its disk.

    Attributes:
        map: whose log.
        log_id: see Mark.
        watermark: every change up to this one is settled: stored, or refused for good.
        refusals: the newest of those that were refused.
        store: random, drawn when the server's store was made; 0 if unknown. A server that has lost its store
            acknowledges with another, and less.
        status_period: least time between two statuses, s, if the server has too many robots for more; else 0.
        stored: the newest change up to the watermark, if the robot did not know the watermark; else None. See
            LogRequest.
    """

    limit = Limit("ack", MAX_SMALL_BYTES)
    map: MapId = field(name="m")
    log_id: Id = field(name="l")
    watermark: Number = field(name="q")
    refusals: Annotated[tuple[Refusal, ...], Meta(max_length=MAX_REFUSALS)] = field(name="r", default=())
    store: Annotated[int, Meta(ge=0, le=2**63 - 1)] = field(name="s", default=0)
    status_period: Annotated[float, Meta(ge=0.0, le=LONGEST_STATUS_PERIOD)] = field(name="p", default=0.0)
    stored: StoredChange | None = field(name="d", default=None)

    def encode(self) -> bytes:
        """The message as bytes, with the newest refusals and the beginning of their reasons."""
        newest = self.refusals[-MAX_REFUSALS:]
        brief = tuple(Refusal(refusal.sequence, refusal.reason[:MAX_REASON]) for refusal in newest)
        return LogMessage.encode(msgspec.structs.replace(self, refusals=brief))


class NewestMap(LogMessage, frozen=True):
    """A server's answer to an agent that is about to begin a map: the highest epoch that it has of it.

    Attributes:
        epoch: 0 if it has no map of this agent.
        pruned: whether each of the nodes that the agent has asked about, see KeptNodes, was pruned.
    """

    limit = Limit("newest map", MAX_SMALL_BYTES)
    epoch: Number = field(name="e")
    pruned: bool = field(name="g", default=False)


class KeptNodes(LogMessage, frozen=True):
    """An agent asks whether some nodes of a map that it has left were all pruned.

    Attributes:
        epoch: of the map.
        numbers: of the nodes.
    """

    limit = Limit("kept nodes", MAX_SMALL_BYTES)
    epoch: Number = field(name="e")
    numbers: Annotated[tuple[Number, ...], Meta(min_length=1, max_length=MAX_KEPT_NODES)] = field(name="n")


class LogRequest(LogMessage, frozen=True):
    """A server asks for the changes first to last, both included.

    Attributes:
        first: the first one.
        last: the last one.
        stored: the newest change before the first that the server has; None if it has none. A robot of which
            the disk was put back has another change by that number.
    """

    limit = Limit("log request", MAX_SMALL_BYTES)
    first: Sequence = field(name="f")
    last: Sequence = field(name="q")
    stored: StoredChange | None = field(name="d", default=None)

    def __post_init__(self) -> None:
        """Refuse what is no range (InvalidValue)."""
        if self.last < self.first:
            raise InvalidValue(f"there are no changes {self.first} to {self.last}")


class LogAnswer(LogMessage, frozen=True):
    """A piece of a log.

    Attributes:
        log_id: see Mark.
        first: as asked.
        covered: how far the answer reaches; less than asked if that would be too much for one answer. What
            is missing up to here was superseded by a later change and is no longer kept.
        changes: (sequence, encoded change), in order. They are not decoded.
    """

    limit = Limit("log answer", MAX_ROWS * MAX_CHANGE_BYTES + MAX_SMALL_BYTES)
    log_id: Id = field(name="l")
    first: Sequence = field(name="f")
    covered: Number = field(name="q")
    changes: Annotated[
        tuple[tuple[Sequence, Annotated[bytes, Meta(max_length=MAX_CHANGE_BYTES)]], ...],
        Meta(max_length=MAX_ROWS),
    ] = field(name="c")

    def __post_init__(self) -> None:
        """Refuse changes that are not in order, or not of the piece (InvalidValue)."""
        steps = [self.first - 1, *(sequence for sequence, _ in self.changes), self.covered + 1]
        if not all(before < after for before, after in pairwise(steps)):
            raise InvalidValue(f"there are changes out of order, or not of {self.first} to {self.covered}")


class _Record(LogMessage, frozen=True):
    limit = Limit("record", MAX_SMALL_BYTES)
    values: Annotated[
        dict[
            Key,
            bool
            | Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
            | Annotated[float, Meta(ge=-MAX_FLOAT, le=MAX_FLOAT)]
            | Annotated[str, Meta(max_length=MAX_SAID)],
        ],
        Meta(max_length=64),
    ] = field(name="s")


def encode_record(values: Mapping[str, Scalar]) -> bytes:
    """Encode a flat record of names and plain values: status lines, answers in words.

    Raises:
        InvalidValue: it would not decode.
    """
    data = _Record(dict(values)).encode()
    try:
        _Record.decode(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def encode_said(words: str) -> bytes:
    """What was done, in words that may be cut: it is done, however many they are."""
    return encode_record({"said": words[:MAX_SAID]})


def decode_record(data: bytes) -> dict[str, Scalar]:
    """Decode a flat record; raises InvalidMessage. What the values mean is the caller's to check."""
    return _Record.decode(data).values
