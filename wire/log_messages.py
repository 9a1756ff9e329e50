"""The small messages around a log: beacon, acknowledgement, range of a log, and flat records for people."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import MapId
from mapweave.wire.codec import MAX_CHANGE_BYTES
from mapweave.wire.packing import MAX_NUMBER, Reader, pack

MARK = struct.Struct("<QQ")
MAX_ROWS = 256
"""Changes in one answer for a range of a log."""

MAX_SERVERS = 64
MAX_REFUSALS = 16
MAX_REASON = 300
MAX_RECORD_FIELDS = 64
MAX_SMALL_BYTES = 65536

Scalar = bool | int | float | str


@dataclass(frozen=True, slots=True)
class Mark:
    """What the attachment of a published change says, so that a receiver can order it undecoded.

    Attributes:
        sequence: of the change.
        log_id: which log this is. Drawn by chance when the log is begun: an agent that has lost its disk
            and counts from one again must not be taken for the one before.
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


@dataclass(frozen=True, slots=True)
class Head:
    """An agent's beacon.

    Attributes:
        log_id: see Mark.
        newest: sequence number of the newest change, 0 if there is none.
        acknowledged: what the agent believes to be on which server's disk. A server that has more says so
            again.
    """

    log_id: int
    newest: int
    acknowledged: Mapping[str, int] = field(default_factory=dict)

    def encode(self) -> bytes:
        """Encode."""
        return pack({"l": self.log_id, "q": self.newest, "a": dict(self.acknowledged)})

    @staticmethod
    def decode(data: bytes) -> Head:
        """Decode; raises InvalidMessage."""
        reader = Reader(data, "head", MAX_SMALL_BYTES)
        acknowledged = {
            reader.as_name(server, "server"): reader.as_integer(watermark, "watermark", 0, MAX_NUMBER)
            for server, watermark in reader.table("a", MAX_SERVERS).items()
        }
        return Head(_log_id(reader), reader.integer("q", 0, MAX_NUMBER), acknowledged)


@dataclass(frozen=True, slots=True)
class Refusal:
    """A change that a server could not take, and why. Sequence 0: the whole log."""

    sequence: int
    reason: str


@dataclass(frozen=True, slots=True)
class Ack:
    """What a server has on its disk.

    Attributes:
        map: whose log.
        log_id: see Mark.
        watermark: every change up to this one is settled: stored, or refused for good.
        refusals: the newest of those that were refused.
        store: drawn by chance when the server's store was made; 0 from a server that does not say. One that
            has lost its store acknowledges with another, and less.
    """

    map: MapId
    log_id: int
    watermark: int
    refusals: tuple[Refusal, ...] = ()
    store: int = 0

    def encode(self) -> bytes:
        """Encode."""
        refusals = [[one.sequence, one.reason[:MAX_REASON]] for one in self.refusals[-MAX_REFUSALS:]]
        fields = {"m": list(self.map), "l": self.log_id, "q": self.watermark, "r": refusals}
        return pack({**fields, "s": self.store} if self.store else fields)

    @staticmethod
    def decode(data: bytes) -> Ack:
        """Decode; raises InvalidMessage."""
        reader = Reader(data, "ack", MAX_SMALL_BYTES)
        refusals = []
        for element in reader.array("r", MAX_REFUSALS):
            pair = reader.as_array(element, "refusal", 2)
            if len(pair) != 2:
                raise reader.error("a refusal must be [sequence, reason]")
            sequence = reader.as_integer(pair[0], "refused sequence", 0, MAX_NUMBER)
            refusals.append(Refusal(sequence, reader.as_text(pair[1], "reason", MAX_REASON)))
        watermark = reader.integer("q", 0, MAX_NUMBER)
        store = reader.integer("s", 0, 2**63 - 1) if reader.has("s") else 0
        return Ack(reader.map_id("m"), _log_id(reader), watermark, tuple(refusals), store)


@dataclass(frozen=True, slots=True)
class NewestMap:
    """A server's answer to an agent that is about to begin a map: the highest epoch that it has of it.

    Attributes:
        epoch: 0 if it has no map of this agent.
    """

    epoch: int

    def encode(self) -> bytes:
        """Encode."""
        return pack({"e": self.epoch})

    @staticmethod
    def decode(data: bytes) -> NewestMap:
        """Decode; raises InvalidMessage."""
        return NewestMap(Reader(data, "newest map", MAX_SMALL_BYTES).integer("e", 0, MAX_NUMBER))


@dataclass(frozen=True, slots=True)
class LogRequest:
    """A server asks for the changes first to last, both included."""

    first: int
    last: int

    def encode(self) -> bytes:
        """Encode."""
        return pack({"f": self.first, "q": self.last})

    @staticmethod
    def decode(data: bytes) -> LogRequest:
        """Decode; raises InvalidMessage."""
        reader = Reader(data, "log request", MAX_SMALL_BYTES)
        first = reader.integer("f", 1, MAX_NUMBER)
        return LogRequest(first, reader.integer("q", first, MAX_NUMBER))


@dataclass(frozen=True, slots=True)
class LogAnswer:
    """A piece of a log.

    Attributes:
        log_id: see Mark.
        first: as asked.
        covered: how far the answer reaches; less than asked if that would be too much for one answer. What
            is missing up to here was superseded by a later change and is no longer kept.
        changes: (sequence, encoded change), in order.
    """

    log_id: int
    first: int
    covered: int
    changes: tuple[tuple[int, bytes], ...]

    def encode(self) -> bytes:
        """Encode."""
        changes = [list(entry) for entry in self.changes]
        return pack({"l": self.log_id, "f": self.first, "q": self.covered, "c": changes})

    @staticmethod
    def decode(data: bytes) -> LogAnswer:
        """Decode; raises InvalidMessage. The changes are not looked at."""
        reader = Reader(data, "log answer", MAX_ROWS * MAX_CHANGE_BYTES + MAX_SMALL_BYTES)
        first = reader.integer("f", 1, MAX_NUMBER)
        covered = reader.integer("q", first - 1, MAX_NUMBER)
        changes = []
        lowest = first
        for value in reader.array("c", MAX_ROWS):
            pair = reader.as_array(value, "a change", 2)
            if len(pair) != 2:
                raise reader.error("a change must be [sequence, change]")
            sequence = reader.as_integer(pair[0], "a change's sequence", lowest, covered)
            changes.append((sequence, reader.as_binary(pair[1], "a change", MAX_CHANGE_BYTES)))
            lowest = sequence + 1
        return LogAnswer(_log_id(reader), first, covered, tuple(changes))


def encode_record(values: Mapping[str, Scalar]) -> bytes:
    """Encode a flat record of names and plain values: status lines, missions, commands to the simulator.

    Raises:
        InvalidValue: it would not decode.
    """
    data = pack({"s": dict(values)})
    try:
        decode_record(data)
    except InvalidMessage as error:
        raise InvalidValue(str(error)) from None
    return data


def decode_record(data: bytes) -> dict[str, Scalar]:
    """Decode a flat record; raises InvalidMessage. What the values mean is the caller's to check."""
    reader = Reader(data, "record", MAX_SMALL_BYTES)
    values: dict[str, Scalar] = {}
    for name, value in reader.table("s", MAX_RECORD_FIELDS).items():
        if type(value) is bool:
            values[name] = value
        elif type(value) is int:
            values[name] = reader.as_integer(value, name, -MAX_NUMBER * 1024, MAX_NUMBER * 1024)
        elif type(value) is float:
            values[name] = reader.as_number(value, name, -1e300, 1e300)
        else:
            values[name] = reader.as_text(value, name, 1024)
    return values


def _log_id(reader: Reader) -> int:
    return reader.integer("l", 0, 2**64 - 1)
