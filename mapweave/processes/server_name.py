"""The name of a map server in its fleet: a second server of one name is refused, or reported where they meet.

Two servers of one name with stores of their own both answer what is asked under it, and acknowledge changes
that the other one does not have.
"""

import logging
import threading
import time

from mapweave.hybridmap.errors import SettingsError
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

log = logging.getLogger(__name__)

ANSWERED = 1.0
"""s; a server that is there answers sooner."""
JOINED = 0.3
"""s; a router that is in reach is joined, and the servers behind it are known, sooner."""
FIRST, EVERY = 2.0, 10.0
"""s until a server looks for another one of its name, and between two looks."""


def refuse_second(bus: Bus, keys: Keys, name: str, patience: float = JOINED) -> None:
    """Ask whether another server has the name, before this one answers under it.

    Args:
        bus: the connection.
        keys: of the fleet.
        name: of this server.
        patience: for how long other routers may be joined meanwhile, s.

    Raises:
        SettingsError: a map server of this name answers.
    """
    end = time.monotonic() + patience
    while not (found := _answering(bus, keys, name)) and time.monotonic() < end:
        time.sleep(patience / 3)
    if found:
        raise SettingsError(
            f"a map server {name} of fleet {keys.fleet} is on this network already: end it, or start this "
            "one with another --name"
        )


class NameWatch:
    """Says in the log when another server of this name has appeared, as when two networks become one.

    Neither of the two ends by itself: both have robots that rely on them.
    """

    def __init__(self, bus: Bus, keys: Keys, name: str, first: float = FIRST, every: float = EVERY) -> None:
        """Begin to look.

        Args:
            bus: the connection.
            keys: of the fleet.
            name: of this server, which answers under it.
            first: until the first look, s.
            every: between two looks, s.
        """
        self._bus, self._keys, self._name = bus, keys, name
        self._first, self._every = first, every
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._look, name="server name", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._stopping.set()
        self._thread.join()

    def _look(self) -> None:
        was_there, pause = False, self._first
        while not self._stopping.wait(pause):
            pause, is_there = self._every, _answering(self._bus, self._keys, self._name) > 1
            if is_there and not was_there:
                log.warning(
                    "another map server %s of fleet %s answers under this name, with a store of its own: end "
                    "one of them, and start it again with another --name",
                    self._name,
                    self._keys.fleet,
                )
            elif was_there and not is_there:
                log.info("no other map server %s answers any more", self._name)
            was_there = is_there


def _answering(bus: Bus, keys: Keys, name: str) -> int:
    """How many servers answer under a name."""
    return len(bus.ask(keys.server_status(name), b"", ANSWERED))
