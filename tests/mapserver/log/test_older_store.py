"""A server on a copy of its store that was made before: it becomes as the robot's map is now."""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.server import MapServer
from mapweave.wire.codec import encode_body
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapserver.log.test_store import node_put
from tests.waiting import eventually

KEYS = Keys("fleet")
MAP = MapId("r0", 1)
PATIENCE = 60.0


@contextmanager
def serving(hub: MemoryHub, path: Path) -> Iterator[MapServer]:
    with closing(MemoryBus(hub)) as bus, MapServer(bus, KEYS, path, "s0") as server:
        yield server


class Robot:
    """A robot's disk, and its link to the fleet."""

    def __init__(self, hub: MemoryHub, folder: Path) -> None:
        self.journal = Journal(folder / "r0.sqlite", "r0")
        self.journal.open_map(1)
        self._bus = MemoryBus(hub)
        self.replicator = Replicator(self._bus, KEYS, self.journal, MAP, servers=("s0",))

    def send(self, *changes: object) -> None:
        self.replicator.submit(changes, 1)  # type: ignore[arg-type]
        assert self.replicator.wait_acknowledged(PATIENCE)

    def close(self) -> None:
        self.replicator.close()
        self._bus.close()
        self.journal.close()


def contents(changes: object) -> list[bytes]:
    return sorted(encode_body(body) for body in HybridMap(changes).contents())  # type: ignore[arg-type]


@pytest.mark.parametrize("restarted", [False, True], ids=["the robot runs on", "it starts again"])
def test_what_was_retired_since_does_not_come_back(tmp_path, restarted: bool):
    """A snapshot of the disk, or a copy by hand: it has the store's own number, and no mark of a backup."""
    hub, path, before = MemoryHub(), tmp_path / "s0.sqlite", tmp_path / "before.sqlite"
    with ExitStack() as stack:
        robot = stack.enter_context(closing(Robot(hub, tmp_path)))
        with serving(hub, path):
            robot.send(*(node_put(k) for k in range(1, 6)))
        shutil.copy(path, before)
        with serving(hub, path):
            robot.send(NodeRetired(NodeId(*MAP, 2)), *(node_put(k) for k in range(6, 9)))
            assert robot.journal.prune(MAP, ["s0"]) == 2, "neither the node nor its retirement is kept"
        if restarted:
            robot.close()
            robot = stack.enter_context(closing(Robot(hub, tmp_path)))
        shutil.copy(before, path)
        wanted = contents(robot.journal.replay(MAP))
        assert len(wanted) == 7
        with serving(hub, path) as server:

            def same() -> bool:
                store: Store = server._store
                known = {str(one) for one in server.merged().poses}
                return (
                    store.watermark(MAP) == robot.journal.head(MAP)
                    and contents(change.body for change in store.replay(MAP)) == wanted
                    and len(known) == 7
                )

            eventually(same, PATIENCE)
            assert server._store.unverified(MAP) is None
