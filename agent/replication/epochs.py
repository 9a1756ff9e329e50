"""Numbers of maps (epochs): small ones that people can read and type, and none that is taken already."""

import secrets
import time
from collections.abc import Collection

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import NewestMap

LARGEST = 999_999
"""Epochs are counted: a larger one from a server is refused, or a server could use the numbers up."""

FOUR_DIGITS = range(1000, 10_000)
"""Of which an epoch is drawn where no server can be asked for the last one: two such maps of one robot have
the same epoch in one of 9000 cases."""

ASK_TIMEOUT = 2.0
"""How long a server may take to answer, s."""

PAUSE = 0.1
"""Between two questions while no server answers, s."""


def newest_on_server(bus: Bus, keys: Keys, server: str, agent: str, patience: float) -> int | None:
    """The highest epoch of an agent's maps that a server has on its disk.

    Args:
        bus: the connection; may be down.
        keys: of the fleet.
        server: which is asked.
        agent: whose maps.
        patience: how long to ask a server that does not answer, s; 0 asks once.

    Returns:
        0 if it has none, None if it does not answer.
    """
    end = time.monotonic() + patience
    while True:
        for reply in bus.ask(keys.ack(server, agent), b"", ASK_TIMEOUT):
            try:
                newest = 0 if reply.error else NewestMap.decode(reply.payload).epoch
            except InvalidMessage:
                continue
            if not reply.error and newest <= LARGEST:
                return newest
        if time.monotonic() >= end:
            return None
        time.sleep(PAUSE)


def next_epoch(taken: Collection[int], stored: int | None) -> int:
    """The number of a new map: one more than any that is known.

    A robot without a map of its own is either new or has lost its disk. Only a server knows which. Without a
    server the number is drawn from four digits: an earlier run of this robot has most probably not used
    it, and if it has, the server says so (the log id differs) and mixes nothing up.

    Args:
        taken: epochs of the maps on the robot's own disk.
        stored: the highest epoch that the server has, 0 for none; None if no server answers.
    """
    if not taken and stored is None:
        return FOUR_DIGITS[secrets.randbelow(len(FOUR_DIGITS))]
    return max([*taken, stored or 0]) + 1
