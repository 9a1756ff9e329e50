"""An agent's log played by hand, and an ingest with its store that can be restarted."""

from collections.abc import Callable
from pathlib import Path

from mapweave.hybridmap.change import Change, NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.agent_log import PullSettings
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.ingest_settings import IngestSettings
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.quotas import Quotas
from mapweave.wire.bus import Request
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, Head, LogAnswer, LogRequest, Mark
from mapweave.wire.memory import MemoryBus, MemoryHub

KEYS = Keys("fleet")
MAP = MapId("r0", 3)
LOG_ID = 77
QUICK = IngestSettings(PullSettings(grace=0.1, first_pause=0.02, longest_pause=0.1), retry_interval=0.05)


def message(sequence: int, map_id: MapId = MAP) -> bytes:
    return encode_change(Change(map_id, sequence, sequence, NodeRetired(NodeId(*map_id, sequence))))


class HandAgent:
    """Does exactly what the test scripts."""

    def __init__(self, hub: MemoryHub, map_id: MapId = MAP, log_id: int = LOG_ID) -> None:
        self.bus = MemoryBus(hub)
        self.map, self.log_id = map_id, log_id
        self.acks: list[Ack] = []
        self.asked: list[LogRequest] = []
        self.log: dict[int, bytes] = {}
        self.bus.subscribe(
            KEYS.acks(map_id.agent), lambda sample: self.acks.append(Ack.decode(sample.payload))
        )

    def publish(self, sequence: int, data: bytes | None = None) -> None:
        mark = Mark(sequence, self.log_id).encode()
        data = message(sequence, self.map) if data is None else data
        self.bus.publish(KEYS.change(self.map), data, mark)

    def publish_each(self, *sequences: int) -> None:
        for sequence in sequences:
            self.publish(sequence)

    def beacon(self, newest: int, **acknowledged: int) -> None:
        self.bus.publish(KEYS.head(self.map), Head(self.log_id, newest, acknowledged).encode())

    def serve(
        self, newest: int, answer: Callable[[LogRequest], LogAnswer | bytes | str] | None = None
    ) -> None:
        """Answer for the log 1 .. newest, or as scripted; text refuses."""
        self.log = {sequence: message(sequence, self.map) for sequence in range(1, newest + 1)}

        def handle(request: Request) -> None:
            asked = LogRequest.decode(request.payload)
            self.asked.append(asked)
            given = answer(asked) if answer else self.answer(asked)
            if isinstance(given, str):
                request.refuse(given)
            else:
                request.reply(given if isinstance(given, bytes) else given.encode())

        self.bus.serve(KEYS.log(self.map), handle)

    def answer(self, asked: LogRequest) -> LogAnswer:
        rows = tuple((s, data) for s, data in self.log.items() if asked.first <= s <= asked.last)
        return LogAnswer(self.log_id, asked.first, min(asked.last, max(self.log)), rows)


class Server:
    """An ingest with its store, which can be restarted."""

    def __init__(
        self,
        hub: MemoryHub,
        path: Path,
        name: str = "s0",
        quotas: Quotas | None = None,
        settings: IngestSettings = QUICK,
    ) -> None:
        self.hub, self.path, self.name, self.quotas, self.settings = hub, path, name, quotas, settings
        self.seen: list[Change] = []
        self.retired: set[MapId] = set()
        self.on_change: Callable[[Change], None] = self.seen.append
        self.begin()

    def begin(self) -> None:
        self.bus = MemoryBus(self.hub)
        self.store = SqliteStore(self.path)
        self.ingest = Ingest(
            self.bus, KEYS, self.store, self.name, lambda c: self.on_change(c), self.settings,
            quotas=self.quotas, retired=lambda: self.retired,
        )  # fmt: skip

    def end(self) -> None:
        self.ingest.close()
        self.bus.close()
        self.store.close()

    def restart(self) -> None:
        self.end()
        self.begin()

    @property
    def sequences(self) -> list[int]:
        return [change.sequence for change in self.seen]
