"""What rmw_zenoh attaches to each message: a number, a time, and who published it.

A ROS 2 process that cannot read the attachment of a message ends. So only the form is written that is read
since rmw_zenoh_cpp 0.1.2 (Humble), 0.2.4 (Jazzy) and 0.6.0, and nothing is ever published without it. The
form of before is read as well.
"""

import struct
from typing import NamedTuple

from mapweave.hybridmap.errors import InvalidMessage

GID_BYTES = 16
"""Of an id of a publisher, by rmw."""
NOW = struct.Struct("<qqB16s")
"""Sequence number, ns since 1970, length of the gid, gid."""
NAMES = (b"sequence_number", b"source_timestamp", b"source_gid")
"""In the form of before each value stands after its name; a name stands after its length, one byte."""


class Attachment(NamedTuple):
    """The attachment of one message.

    Attributes:
        sequence: counts a publisher's messages, from 1.
        stamp_ns: when it was published.
        gid: 16 bytes that identify the publisher.
    """

    sequence: int
    stamp_ns: int
    gid: bytes


def encode_attachment(attachment: Attachment) -> bytes:
    """33 bytes."""
    return NOW.pack(attachment.sequence, attachment.stamp_ns, GID_BYTES, attachment.gid)


def decode_attachment(data: bytes) -> Attachment:
    """Read either form.

    Raises:
        InvalidMessage: it is neither.
    """
    if len(data) == NOW.size and data[16] == GID_BYTES:
        sequence, stamp_ns, _, gid = NOW.unpack(data)
        return Attachment(sequence, stamp_ns, gid)
    values, at = [], 0
    for name, size in zip(NAMES, (8, 8, 1 + GID_BYTES), strict=True):
        begin = at + 1 + len(name)
        if data[at : at + 1] != bytes([len(name)]) or data[at + 1 : begin] != name:
            raise InvalidMessage(f"attachment: {len(data)} bytes of an unknown form")
        at = begin + size
        values.append(data[begin:at])
    if at != len(data) or values[2][0] != GID_BYTES:
        raise InvalidMessage(f"attachment: {len(data)} bytes of an unknown form")
    sequence, stamp_ns = struct.unpack("<qq", values[0] + values[1])
    return Attachment(sequence, stamp_ns, values[2][1:])
