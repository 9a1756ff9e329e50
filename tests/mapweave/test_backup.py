"""`mapweave map backup`: copies of stores and journals whose processes run on."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from mapweave import Fleet, HybridMap, MapId, maps_of
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import COMPACTED, Replicator
from mapweave.cli import main
from mapweave.exit_status import USAGE
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.change import NodePut
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.plan_images import kept_images
from mapweave.mapserver.retrieval.landmark_index import LandmarkIndexSettings
from mapweave.opened_map import open_map
from mapweave.scenarios.children import Children
from mapweave.storage.database_reader import reading
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_body, encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, decode_record
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapserver.log.acknowledged_fleet import AGENT, life
from tests.mapserver.log.test_front_servers import Log, logs_of
from tests.mapweave.command_line import complaint
from tests.mapweave.test_opened_map import LOGS, annotated_store
from tests.programs import mapweave
from tests.waiting import eventually, free_port

KEYS = Keys("fleet")
PATIENCE = 120.0


def stored(path: Path) -> dict[MapId, Log]:
    """The logs of a store that no server has open."""
    with closing(SqliteStore(path)) as store:
        return {m: [(c.sequence, encode_change(c)) for c in store.replay(m)] for m in store.maps()}


def contents(hybrid: HybridMap) -> list[bytes]:
    return sorted(map(encode_body, hybrid.contents()))


def settled(path: Path) -> dict[MapId, int]:
    """Up to which change the store of a running server has each log."""
    with reading(path, live=True) as connection:
        rows = connection.execute("SELECT agent, epoch, watermark FROM log").fetchall()
    return {MapId(agent, epoch): watermark for agent, epoch, watermark in rows}


def compared(path: Path) -> bool:
    """Whether the server has compared all logs with the robots' own."""
    with reading(path, live=True) as connection:
        return not connection.execute("SELECT count(*) FROM unverified").fetchone()[0]


@contextmanager
def mapping(journals: list[Journal], bus: ZenohBus, rng: np.random.Generator) -> Iterator[list[Replicator]]:
    """Robots that map on and on, each in its own thread."""
    robots = [Replicator(bus, KEYS, one, one.open_map(1), ("s0",), AGENT) for one in journals]
    stop = threading.Event()

    def drive(robot: Replicator, bodies: list) -> None:
        for k in range(0, len(bodies), 2):
            if stop.wait(0.03):
                return
            robot.submit(bodies[k : k + 2], k)

    tours = [life(MapId(one.agent, 1), rng, 600, landmarks=60) for one in journals]
    # On any machine, robots drop nothing from their logs, and the search for similar nodes is exact.
    assert max(map(len, tours)) < COMPACTED
    nodes = [change.node for tour in tours for change in tour if isinstance(change, NodePut)]
    assert sum(len(node.landmarks) for node in nodes) < LandmarkIndexSettings().exact
    # Kernels are compiled after some calls, for which the robots would pause.
    for body in tours[0]:
        encode_body(body)
    threads = [threading.Thread(target=drive, args=pair) for pair in zip(robots, tours, strict=True)]
    for thread in threads:
        thread.start()
    try:
        yield robots
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def status(bus: ZenohBus) -> Mapping[str, Scalar]:
    """What the server says of itself; nothing if it does not answer."""
    replies = [reply for reply in bus.ask(KEYS.server_status("s0"), b"", 5.0) if not reply.error]
    return decode_record(replies[0].payload) if replies else {}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_running_servers_store_is_backed_up_and_a_server_on_it_is_completed(tmp_path):
    """The drill of docs/fleet-server.md, with processes that are real and robots that never pause."""
    endpoint, backup = f"tcp/127.0.0.1:{free_port()}", tmp_path / "backup" / "monday.sqlite"
    backup.parent.mkdir()
    journals = [Journal(tmp_path / name, name) for name in ("r0", "r1")]
    names = {MapId(one.agent, 1): one for one in journals}

    def server(children: Children, data: Path) -> None:
        children.start("server", ["server", "--fleet", "fleet", "--data", str(data), "--listen", endpoint])

    with Children(tmp_path / "logs") as children:
        server(children, tmp_path / "first")
        bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        with mapping(journals, bus, np.random.default_rng(5)) as robots:

            def acknowledged() -> dict[MapId, int]:
                return {m: one.acknowledged(m).get("s0", 0) for m, one in names.items()}

            eventually(lambda: min(acknowledged().values(), default=0) > 100, PATIENCE)
            before = acknowledged()
            ran = mapweave("map", "backup", tmp_path / "first" / "s0.sqlite", "-o", backup, timeout=None)
            assert (ran.returncode, ran.stderr) == (0, "")
            assert ran.stdout.startswith(f"{backup}: copy of the store")
            after = acknowledged()
            assert all(after[m] > before[m] for m in before), "the server goes on during the backup"
        for robot in robots:
            assert robot.wait_acknowledged(PATIENCE), "the server goes on after the backup"
        truth = logs_of(journals)
        children.end("server")
        assert stored(tmp_path / "first" / "s0.sqlite") == truth
        for robot in robots:
            robot.close()
        bus.close()

        kept = stored(backup)
        for map_id, log in kept.items():
            assert log == truth[map_id][: len(log)]
            assert before[map_id] <= len(log) < len(truth[map_id])
        second = tmp_path / "second"
        second.mkdir()
        (second / "s0.sqlite").write_bytes(backup.read_bytes())
        then = open_map(backup)
        server(children, second)
        bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        eventually(lambda: status(bus).get("nodes") == len(HybridMap(then.content.changes).nodes), PATIENCE)
        eventually(lambda: status(bus).get("settled"), PATIENCE)
        fetched = tmp_path / "fetched.mapweave"
        with Fleet([endpoint], "fleet") as fleet:
            fetched.write_bytes(fleet.map_bytes())
        assert content_hash(open_map(fetched).content) == content_hash(then.file(then.merged()))

        robots = [Replicator(bus, KEYS, one, MapId(one.agent, 1), ("s0",), AGENT) for one in journals]
        heads = {m: one.head(m) for m, one in names.items()}
        eventually(lambda: settled(second / "s0.sqlite") == heads, PATIENCE)
        eventually(lambda: compared(second / "s0.sqlite"), PATIENCE)
        for robot in robots:
            robot.close()
        bus.close()
    # A robot drops what later changes undo, so the log may be shorter; the map is the same.
    maps = maps_of(open_map(second / "s0.sqlite").content)
    for map_id, one in names.items():
        assert contents(maps[map_id]) == contents(HybridMap(one.replay(map_id)))
        one.close()


def test_a_backup_has_decisions_and_is_a_store_like_the_first(tmp_path, capfd):
    path, out = annotated_store(tmp_path / "s0.sqlite", LOGS), tmp_path / "copy.sqlite"
    plans = tmp_path / "s0.sqlite.plans"
    plans.mkdir()
    (plans / "a1.png").write_bytes(b"an image")
    before = open_map(path).content
    with closing(SqliteStore(path)) as running:
        assert main(["map", "backup", str(path), "-o", str(out)]) == 0
        assert running.constraints()
    assert capfd.readouterr().out.startswith(f"{out}: copy of the store, ")
    content = open_map(out).content
    assert content_hash(content) == content_hash(before)
    assert (content.constraints, content.annotations) == (before.constraints, before.annotations)
    assert (tmp_path / "copy.sqlite.plans" / "a1.png").read_bytes() == b"an image"
    assert kept_images(out, Annotations(content.annotations)) == {}


def test_what_cannot_be_backed_up_is_one_line(tmp_path, capfd):
    path, out = annotated_store(tmp_path / "s0.sqlite", LOGS), tmp_path / "copy"
    assert main(["map", "backup", str(path), "-o", str(out)]) == 0
    capfd.readouterr()

    def refused(source: object, to: Path, **status: int) -> str:
        return complaint(capfd, "map", "backup", source, "-o", to, **status)

    kept = out.read_bytes()
    assert "copy: is there already, and is not written over" in refused(path, out)
    assert out.read_bytes() == kept
    assert f"there is no folder {tmp_path / 'no'}" in refused(path, tmp_path / "no" / "copy")
    assert "none: no such file" in refused(tmp_path / "none", tmp_path / "b")
    (tmp_path / "text").write_text("no map")
    assert "text: is neither" in refused(tmp_path / "text", tmp_path / "b")
    with closing(Journal(tmp_path / "r0.sqlite", "r0")):
        line = refused(tmp_path / "r0.sqlite", tmp_path / "b")
    assert "r0.sqlite: is a journal, not a server's store" in line
    line = refused("postgresql://anna:secret@db1/maps", tmp_path / "b", status=USAGE)
    assert "pg_dump" in line and "secret" not in line
    assert not (tmp_path / "b").exists()
