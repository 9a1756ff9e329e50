"""Says that map servers with stores of their own do not exchange what people decide."""

import logging

from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

log = logging.getLogger(__name__)


class SeparateStores:
    """Watches for other servers beside one whose store no other has, and names each once."""

    def __init__(self, bus: Bus, keys: Keys, name: str) -> None:
        """Begin to watch."""
        self._name, self._seen = name, set[str]()
        self._watch = bus.watch(keys.servers_alive(), self._see)

    def close(self) -> None:
        """Watch no more."""
        self._watch.close()

    def _see(self, key: str, alive: bool) -> None:
        other = key.split("/")[-2]
        if not alive or other == self._name or other in self._seen:
            return
        self._seen.add(other)
        log.warning(
            "map server %s does not have this one's store: what people decide on the page of one does not "
            "reach the other, and is missing while that one is down; give decisions by commands, which ask "
            "both, or let both share a PostgreSQL (--store)",
            other,
        )
