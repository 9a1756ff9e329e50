"""Bytes between a server and its gateway: a head of fixed length, then a message or words."""

from __future__ import annotations

import struct
from typing import NamedTuple

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.mapserver.cluster.messages import MOST_BYTES

REQUEST = struct.Struct("<qi")
"""Number and target."""
REPLY = struct.Struct("<q?")
"""Number, and whether words follow instead of a message."""
MOST_FRAME = MOST_BYTES + max(REQUEST.size, REPLY.size)
"""Bytes; `Connection.recv_bytes` reads no more."""
MOST_WORDS = 500
"""Characters of an error that are passed on."""


class GatewayRequest(NamedTuple):
    """What a server asks.

    Attributes:
        number: of the request.
        target: number of a shard, or `mapweave.mapserver.cluster.gateway.WORK`.
        message: for it.
    """

    number: int
    target: int
    message: bytes

    def packed(self) -> bytes:
        """The frame as bytes."""
        return REQUEST.pack(self.number, self.target) + self.message

    @staticmethod
    def read(data: bytes) -> GatewayRequest:
        """Read a frame of bytes.

        Raises:
            InvalidMessage: they are too few.
        """
        number, target = _head(REQUEST, data)
        return GatewayRequest(number, target, data[REQUEST.size :])


class GatewayReply(NamedTuple):
    """What its gateway says. The first reply says how many workers there are.

    Attributes:
        number: of the request; of workers, in the first reply.
        message: the answer.
        words: why there is none; empty if there is one.
    """

    number: int
    message: bytes = b""
    words: str = ""

    def packed(self) -> bytes:
        """The frame as bytes; of long words the first ones."""
        tail = self.words[:MOST_WORDS].encode(errors="replace") if self.words else self.message
        return REPLY.pack(self.number, bool(self.words)) + tail

    @staticmethod
    def read(data: bytes) -> GatewayReply:
        """Read a frame of bytes.

        Raises:
            InvalidMessage: they are too few.
        """
        number, failed = _head(REPLY, data)
        tail = data[REPLY.size :]
        return (
            GatewayReply(number, b"", tail.decode(errors="replace")) if failed else GatewayReply(number, tail)
        )


def _head(form: struct.Struct, data: bytes) -> tuple[int, ...]:
    if len(data) < form.size:
        raise InvalidMessage(
            f"{len(data)} bytes between a server and its gateway, at least {form.size} are needed"
        )
    return form.unpack_from(data)
