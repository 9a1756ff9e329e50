"""Robots with journals and a server with a store, and what of them is on the disk."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import ReplicationSettings, Replicator
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.log.agent_log import PullSettings
from mapweave.mapserver.log.ingest import Ingest
from mapweave.mapserver.log.ingest_settings import IngestSettings
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.codec import encode_body, encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

KEYS = Keys("fleet")
AGENT = ReplicationSettings(beacon_interval=0.02, answer_bytes=20_000)
SERVER = IngestSettings(PullSettings(grace=0.01, first_pause=0.02, longest_pause=0.1))
CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)
HERE = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)
ROBOTS = ("r0", "r1", "r2")


def node(map_id: MapId, number: int, rng: np.random.Generator, landmarks: int = 200) -> NodePut:
    count = int(rng.integers(0, landmarks))
    seen = Landmarks(
        rng.uniform(0, 230, (count, 2)).astype(np.float32), rng.integers(0, 9, (count, 32)).astype(np.uint8),
        rng.uniform(0.5, 5, count).astype(np.float32), np.full(count, 0.05, np.float32),
    )  # fmt: skip
    return NodePut(Node(NodeId(*map_id, number), number, HERE, CAMERA, seen))


def edge(map_id: MapId, number: int, a: int, b: int) -> EdgePut:
    ends = NodeId(*map_id, a), NodeId(*map_id, b)
    return EdgePut(Edge(NodeId(*map_id, number), *ends, HERE, EdgeKind.MAPPED))


def life(map_id: MapId, rng: np.random.Generator, length: int, landmarks: int = 200) -> list[ChangeBody]:
    """Nodes with fewer landmarks than this, and edges; some are put again, some are retired."""
    changes: list[ChangeBody] = []
    nodes: list[int] = []
    edges: list[int] = []
    for number in range(1, length):
        draw = rng.random()
        if len(nodes) < 3 or not edges or draw < 0.5:
            changes.append(node(map_id, number, rng, landmarks))
            nodes.append(number)
            if len(nodes) > 1:
                edges.append(1000 + number)
                changes.append(edge(map_id, edges[-1], nodes[-2], number))
        elif draw < 0.7:
            changes.append(node(map_id, int(rng.choice(nodes)), rng, landmarks))
        elif draw < 0.8:
            a, b = rng.choice(nodes, 2, replace=False)
            changes.append(edge(map_id, int(rng.choice(edges)), int(a), int(b)))
        elif draw < 0.9:
            changes.append(EdgeRetired(NodeId(*map_id, edges.pop(int(rng.integers(len(edges)))))))
        else:
            changes.append(NodeRetired(NodeId(*map_id, nodes.pop(int(rng.integers(len(nodes)))))))
    return changes


@dataclass
class Fleet:
    """Robots with their journals and a server with its store, in one folder."""

    folder: Path
    seen: list[Change] = field(default_factory=list)
    robots: list[tuple[Replicator, Journal, MemoryBus]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.hub = MemoryHub()

    @property
    def path(self) -> Path:
        return self.folder / "s0.sqlite"

    def start_server(self) -> None:
        self.seen.clear()
        self.bus = MemoryBus(self.hub)
        self.store = SqliteStore(self.path)
        self.ingest = Ingest(self.bus, KEYS, self.store, "s0", self.seen.append, SERVER)

    def stop_server(self) -> None:
        self.ingest.close()
        self.bus.close()
        self.store.close()

    def start_robots(self) -> None:
        for name in ROBOTS:
            bus, journal = MemoryBus(self.hub), Journal(self.folder / name, name)
            one = Replicator(bus, KEYS, journal, journal.open_map(1), ("s0",), AGENT)
            self.robots.append((one, journal, bus))

    def stop_robots(self) -> None:
        while self.robots:
            replicator, journal, bus = self.robots.pop()
            replicator.close()
            bus.close()
            journal.close()

    def start(self) -> None:
        self.start_server()
        self.start_robots()

    def stop(self) -> None:
        self.stop_robots()
        self.stop_server()

    @contextmanager
    def disk(self) -> Iterator[sqlite3.Connection]:
        """The store of a server that is stopped, to be changed behind its back."""
        with closing(sqlite3.connect(self.path)) as disk, disk:
            yield disk

    def lacks(self) -> int:
        """Changes that robots keep and the store does not have as they are. Robots drop what was undone."""
        stored = self.stored()
        return sum(
            encode_change(change) not in stored[one]
            for _, journal, _ in self.robots
            for one in journal.maps()
            for change in journal.changes(one, 1, journal.head(one))
        )

    def stored(self) -> dict[MapId, list[bytes]]:
        return {
            one: [encode_change(change) for change in self.store.replay(one)] for one in self.store.maps()
        }

    def served(self) -> dict[MapId, list[bytes]]:
        """What the rest of the server has received, as maps."""
        maps: dict[MapId, HybridMap] = {}
        for change in self.seen:
            maps.setdefault(change.map, HybridMap()).apply(change.body)
        return {one: sorted(map(encode_body, hybrid.contents())) for one, hybrid in maps.items()}


@cache
def truth(whole: Path) -> tuple[dict[MapId, list[bytes]], dict[MapId, list[bytes]]]:
    """Logs, and the maps that they make, by the journals."""
    logs, maps = {}, {}
    for name in ROBOTS:
        journal = Journal(whole / name, name)
        (one,) = journal.maps()
        logs[one] = [encode_change(change) for change in journal.changes(one, 1, journal.head(one))]
        maps[one] = sorted(map(encode_body, HybridMap(journal.replay(one)).contents()))
        journal.close()
    return logs, maps


def journal_bodies(whole: Path, one: MapId) -> list[ChangeBody]:
    journal = Journal(whole / one.agent, one.agent)
    changes = list(journal.replay(one))
    journal.close()
    return changes


def bodies_in(path: Path) -> list[tuple[MapId, int, bytes]]:
    with closing(sqlite3.connect(path)) as disk:
        rows = disk.execute("SELECT agent, epoch, sequence, body FROM change").fetchall()
    return [(MapId(agent, epoch), sequence, body) for agent, epoch, sequence, body in rows]


def flip(path: Path, at: int, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1 << bit
    path.write_bytes(bytes(data))
