"""Notifies agents up to where their logs are on the disk, or why they are not taken."""

from __future__ import annotations

from collections.abc import Callable, Collection

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, check_name
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.store import Store
from mapweave.wire.bus import Bus, Closing, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, NewestMap, Refusal


class Acknowledgements:
    """Those of one server."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        server_name: str,
        store: Store,
        taken: Collection[MapId],
        status_period: Callable[[str], float],
    ) -> None:
        """Begin with nothing sent.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            server_name: under which they go out.
            store: has the logs; stays the caller's.
            taken: maps that are here and not in the store: no new one may have their names.
            status_period: of a robot's statuses, s; 0: its own.
        """
        self._bus, self._keys, self._name = bus, keys, check_name(server_name)
        self._store, self._taken = store, tuple(taken)
        self._status_period = status_period

    def serve(self) -> Closing:
        """Begin to answer which numbers an agent must not give to a new map: it may have lost its disk."""
        return self._bus.serve(self._keys.all_acks(self._name), self._tell_newest)

    def acknowledge(self, agent_log: AgentLog) -> None:
        """Notify an agent of what is settled."""
        watermark, refusals = agent_log.watermark, agent_log.refusals
        self._send(
            Ack(
                agent_log.map,
                agent_log.log_id,
                watermark,
                refusals,
                self._store.id,
                self._status_period(agent_log.map.agent),
            )
        )

    def refuse(self, map_id: MapId, log_id: int, reason: str, watermark: int = 0) -> None:
        """Notify an agent that its log is not taken, or not beyond the watermark."""
        self._send(Ack(map_id, log_id, watermark, (Refusal(0, reason),), self._store.id))

    def _send(self, ack: Ack) -> None:
        self._bus.publish(self._keys.ack(self._name, ack.map.agent), ack.encode())

    def _tell_newest(self, request: Request) -> None:
        _, agent = self._keys.parse_ack(request.key)
        try:
            maps = (*self._store.maps(agent), *self._taken)
        except InvalidFile as error:
            request.refuse(str(error))
            return
        epochs = (known.epoch for known in maps if known.agent == agent)
        request.reply(NewestMap(max(epochs, default=0)).encode())
