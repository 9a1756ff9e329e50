"""What goes back instead of an answer, as bytes: why, and when it is worth asking again."""

import math
import struct

from mapweave.hybridmap.limits import MAX_WORDS
from mapweave.wire.bus import Reply

MARK = b"refused: "
"""Begins a refusal that a handler made; all other errors are Zenoh's own, like its "Timeout"."""
LONGEST_PAUSE = 3600.0
"""Longest retry time, s."""
_END = b"\0"


def encode_refusal(reason: str, retry_after: float = 0.0) -> bytes:
    """Encode a refusal.

    Args:
        reason: in words.
        retry_after: seconds after which the same question may be answered; 0: to ask again does not help.
    """
    words = MARK + (reason or "refused").replace("\0", " ").encode(errors="replace")
    return words + _END + struct.pack("<f", min(retry_after, LONGEST_PAUSE)) if retry_after > 0.0 else words


def decode_refusal(data: bytes) -> Reply | None:
    """What a server or robot refused, in words that a message can hold; None for what is none's word."""
    if not data.startswith(MARK):
        return None
    words, _, pause = data[len(MARK) :].partition(_END)
    (seconds,) = struct.unpack("<f", pause) if len(pause) == 4 else (0.0,)
    usable = math.isfinite(seconds) and 0.0 < seconds <= LONGEST_PAUSE
    reason = "".join(c if c.isprintable() else " " for c in words[: 4 * MAX_WORDS].decode(errors="replace"))
    return Reply(error=reason[:MAX_WORDS] or "refused", retry_after=seconds if usable else 0.0)
