"""Notifies agents up to where their logs are on the disk, or why they are not taken."""

from collections.abc import Callable, Collection, Iterable

from mapweave.hybridmap.errors import InvalidFile, InvalidMessage
from mapweave.hybridmap.ids import MapId, NodeId, check_name
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.store import Store
from mapweave.wire.bus import Bus, Closing, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, KeptNodes, NewestMap, Refusal


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
        pruned: Callable[[NodeId], bool],
    ) -> None:
        """Begin with nothing sent.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            server_name: under which they go out.
            store: has the logs; stays the caller's.
            taken: maps that are here and not in the store: no new one may have their names.
            status_period: of a robot's statuses, s; 0: its own.
            pruned: whether a node has left the map for good, since it was superseded.
        """
        self._bus, self._keys, self._name = bus, keys, check_name(server_name)
        self._store, self._taken = store, tuple(taken)
        self._status_period, self._pruned = status_period, pruned

    def serve(self) -> Closing:
        """Begin to answer which numbers an agent must not give to a new map, since it may have lost its disk,
        and whether maps that it has left were pruned.
        """
        return self._bus.serve(self._keys.all_acks(self._name), self._tell_newest)

    def acknowledge(self, agent_log: AgentLog, compared: bool = False) -> None:
        """Notify an agent of what is settled.

        Args:
            agent_log: of which.
            compared: with the newest change, so that the agent sees whether its log has it.

        Raises:
            InvalidFile: the store cannot be read, where it is compared.
        """
        map_id, watermark = agent_log.map, agent_log.watermark
        period = self._status_period(map_id.agent)
        stored = self._store.newest_change(map_id, watermark) if compared else None
        self._send(
            Ack(map_id, agent_log.log_id, watermark, agent_log.refusals, self._store.id, period, stored)
        )

    def refuse(self, map_id: MapId, log_id: int, reason: str, watermark: int = 0) -> None:
        """Notify an agent that its log is not taken, or not beyond the watermark."""
        self._send(Ack(map_id, log_id, watermark, (Refusal(0, reason),), self._store.id))

    def _send(self, ack: Ack) -> None:
        self._bus.publish(self._keys.ack(self._name, ack.map.agent), ack.encode())

    def _tell_newest(self, request: Request) -> None:
        _, agent = self._keys.parse_ack(request.key)
        try:
            kept = KeptNodes.decode(request.payload) if request.payload else None
            maps = (*self._store.maps(agent), *self._taken)
            pruned = kept is not None and self._all_pruned(MapId(agent, kept.epoch), kept.numbers)
        except (InvalidFile, InvalidMessage) as error:
            request.refuse(str(error))
            return
        epochs = (known.epoch for known in maps if known.agent == agent)
        request.reply(NewestMap(max(epochs, default=0), pruned).encode())

    def _all_pruned(self, map_id: MapId, numbers: Iterable[int]) -> bool:
        """Whether none of some nodes is in the store since each of them was pruned.

        A node that its robot has sent again is there again, perhaps not yet in the merged map.
        """
        nodes = [NodeId(*map_id, number) for number in numbers]
        return all(map(self._pruned, nodes)) and all(self._store.landmarks(node) is None for node in nodes)
