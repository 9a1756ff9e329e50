"""Map servers on a PostgreSQL that Patroni keeps, configured as docs/operations.md says."""

import threading
import time
from collections.abc import Mapping
from contextlib import closing
from itertools import count
from pathlib import Path

import numpy as np
import psycopg
import pytest

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.scenarios.children import Children
from mapweave.wire.bus import Bus
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, decode_record
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapserver.log.acknowledged_fleet import AGENT, node
from tests.mapserver.log.test_front_servers import logs_of
from tests.patroni import PatroniCluster, patroni_cluster
from tests.waiting import eventually, free_port

KEYS = Keys("fleet")
PATIENCE = 120.0
WITHOUT = 12.0
"""s without an acknowledgement that show that there will be none: the watchdog of a session has passed."""


class Robot:
    """Maps on and on, whatever becomes of its changes."""

    def __init__(self, folder: Path, bus: Bus, name: str) -> None:
        self.map_id = MapId(name, 1)
        self.journal = Journal(folder / name, name)
        self.journal.open_map(1)
        self.replicator = Replicator(bus, KEYS, self.journal, self.map_id, ("s0",), AGENT)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._map)
        self._thread.start()

    def _map(self) -> None:
        rng = np.random.default_rng(5)
        for number in count(1):
            if self._ending.wait(0.1):
                return
            self.replicator.submit([node(self.map_id, number, rng, landmarks=8)], 1)

    @property
    def acknowledged(self) -> int:
        """Changes, of the first ones."""
        status = self.replicator.status()
        return status.newest - status.unacknowledged

    def wait_more(self) -> float:
        """Wait until ten further ones are acknowledged; returns how long that took, s."""
        began, before = time.monotonic(), self.acknowledged
        eventually(lambda: self.acknowledged >= before + 10, PATIENCE)
        return time.monotonic() - began

    def stop(self) -> None:
        """Map no more; what is mapped is still sent."""
        self._ending.set()
        self._thread.join()

    def close(self) -> None:
        """End it; its journal stays open."""
        self.stop()
        self.replicator.close()


def stored(cluster: PatroniCluster) -> dict[MapId, list[tuple[int, bytes]]]:
    """All that the primary has. Who only reads may read from a standby, which may lag behind."""
    primary = f"{cluster.address('maps')}?target_session_attrs=read-write"
    with closing(PostgresStore(primary, read_only=True)) as store:
        return {m: [(c.sequence, encode_change(c)) for c in store.replay(m)] for m in store.maps()}


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.timeout(900)
def test_a_fleet_outlives_its_primaries_and_nothing_acknowledged_is_lost(tmp_path):
    with patroni_cluster() as cluster, Children(tmp_path / "logs") as servers:
        admin = f"{cluster.address('postgres', 'postgres')}?target_session_attrs=read-write"
        with psycopg.connect(admin, autocommit=True) as people:
            for name, value in (("data_checksums", "on"), ("server_encoding", "UTF8")):
                assert people.execute(f"SHOW {name}").fetchone() == (value,)
            people.execute("CREATE ROLE mapweave LOGIN")
            people.execute("CREATE DATABASE maps OWNER mapweave")
        endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
        for k, name in enumerate(("s0", "s1")):
            servers.start(
                name,
                ["server", "--fleet", "fleet", "--name", name, "--store", cluster.address("maps"), "--data",
                 str(tmp_path / name), "--listen", endpoints[k], "--connect", endpoints[1 - k]],
            )  # fmt: skip
        bus = ZenohBus(BusSettings(mode="client", endpoints=tuple(endpoints)))

        def status(name: str) -> Mapping[str, Scalar]:
            servers.check()
            replies = bus.ask(KEYS.server_status(name), b"", 5.0)
            return next((decode_record(reply.payload) for reply in replies if not reply.error), {})

        eventually(lambda: sum(bool(status(name).get("leads")) for name in ("s0", "s1")) == 1, PATIENCE)
        lost, robot = Robot(tmp_path, bus, "r0"), Robot(tmp_path, bus, "r1")
        lost.wait_more()
        robot.wait_more()

        # A robot is lost with the primary, so that no one can send again what was acknowledged to it.
        first = cluster.primary()
        first.kill()
        acknowledged = lost.acknowledged
        lost.close()
        outages = [robot.wait_more()]
        second = cluster.primary()
        assert second is not first and acknowledged >= 10
        kept = stored(cluster)[lost.map_id]
        assert len(kept) >= acknowledged and kept == logs_of([lost.journal])[lost.map_id][: len(kept)]

        # The former primary comes back as a standby by itself, so there is one for the next failover, too.
        first.start()
        cluster.wait_complete()
        second.kill()
        outages.append(robot.wait_more())
        second.start()
        cluster.wait_complete()

        # Without a standby nothing is acknowledged, and the servers say so.
        primary = cluster.primary()
        standbys = [member for member in cluster.members.values() if member is not primary]
        for member in standbys:
            member.kill()
        eventually(lambda: "standby" in str(status("s0").get("event")), PATIENCE)
        before = robot.acknowledged
        time.sleep(WITHOUT)
        assert robot.acknowledged == before
        for member in standbys:
            member.start()
        outages.append(robot.wait_more())
        cluster.wait_complete()

        robot.stop()
        assert robot.replicator.wait_acknowledged(PATIENCE)
        assert stored(cluster)[robot.map_id] == logs_of([robot.journal])[robot.map_id]
        servers.check()
        print("no acknowledgement for", [f"{seconds:.1f} s" for seconds in outages])
        robot.close()
        for one in (lost, robot):
            one.journal.close()
        bus.close()
