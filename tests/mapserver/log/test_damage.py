"""Flipped bits in the store: the server starts, says what is lost, and robots make the store whole again."""

import shutil
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.replication.journal import Draft, Journal
from mapweave.cli import main
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.mapserver.explainer import ConstraintRecord
from mapweave.mapserver.log.entry import Traffic
from mapweave.mapserver.log.integrity import checksum
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.storage.map_file import read_map_file
from mapweave.wire.codec import encode_body, encode_change
from tests.mapserver.log.acknowledged_fleet import ROBOTS, Fleet, bodies_in, flip, journal_bodies, life, truth
from tests.quick import first_quick
from tests.waiting import eventually, free_port

PAGE = 4096


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of three robots, which a server has acknowledged, and some manual constraints."""
    fleet = Fleet(tmp_path_factory.mktemp("whole"))
    rng = np.random.default_rng(7)
    for name in ROBOTS:
        journal = Journal(fleet.folder / name, name)
        map_id = journal.open_map(None)
        journal.write(map_id, [Draft.of(body, k) for k, body in enumerate(life(map_id, rng, 25))])
        journal.close()
    fleet.start()
    for replicator, _, _ in fleet.robots:
        assert replicator.wait_acknowledged(30)
    book = ConstraintRecord(fleet.store)
    for k in range(5):
        book.add(
            ManualConstraint(Apart((MapId("r0", 1), MapId(f"r{k + 1}", 1))), True, "anna", k, "two kitchens")
        )
    fleet.stop()
    return fleet.folder


@pytest.fixture
def fleet(whole: Path, tmp_path: Path) -> Iterator[Fleet]:
    shutil.copytree(whole, tmp_path / "fleet")
    fleet = Fleet(tmp_path / "fleet")
    yield fleet
    fleet.stop_robots()


def total(store: Store) -> Traffic:
    """The traffic of all maps, by adding up."""
    return Traffic(
        *(sum(column) for column in zip(*(astuple(store.traffic(m)) for m in store.maps()), strict=True))
    )


def all_is_whole(store: Store) -> bool:
    return not store.damaged() and not any(map(store.unverified, store.maps()))


@pytest.mark.parametrize("seed", first_quick(range(14), 1, 6))
def test_a_flipped_bit_in_a_change_is_healed_by_its_robot(whole: Path, fleet: Fleet, seed: int, caplog):
    logs, maps = truth(whole)
    rng = np.random.default_rng(seed)
    rows = bodies_in(fleet.path)
    data = fleet.path.read_bytes()
    hit: set[tuple[MapId, int]] = set()
    for _ in range(int(rng.integers(1, 4))):
        # A body that is too long for its page lies in several pieces.
        while True:
            map_id, sequence, body = rows[rng.integers(len(rows))]
            start = int(rng.integers(max(len(body) - 40, 1)))
            position = data.find(body[start : start + 40])
            if len(body) > 60 and position >= 0 and data.count(body[start : start + 40]) == 1:
                break
        flip(fleet.path, position + int(rng.integers(40)), int(rng.integers(8)))
        hit.add((map_id, sequence))
    fleet.start_server()
    lost = {(gap.map, k) for gap in fleet.store.damaged() for k in range(gap.first, gap.last + 1)}
    assert hit == lost
    for map_id, sequence in hit:
        assert f"{sequence}" in caplog.text and f"of {map_id}" in caplog.text
    # All others are served at once.
    served = {(change.map, change.sequence): encode_change(change) for change in fleet.seen}
    expected = {(one, k): data for one, log in logs.items() for k, data in enumerate(log, 1)}
    assert served == {key: data for key, data in expected.items() if key not in hit}
    assert fleet.store.traffic() == total(fleet.store)
    fleet.start_robots()
    eventually(lambda: all_is_whole(fleet.store))
    fleet.ingest.close()
    assert fleet.store.traffic() == total(fleet.store), "what is healed is counted"
    assert fleet.lacks() == 0
    fleet.stop_robots()
    assert all(set(log) <= set(logs[one]) for one, log in fleet.stored().items())
    assert fleet.served() == maps, "what came late must not undo what came after it"
    fleet.stop_server()
    caplog.clear()
    fleet.start_server()
    assert fleet.served() == maps and "damaged" not in caplog.text
    fleet.stop_server()


@pytest.mark.parametrize("compacted", [False, True])
@pytest.mark.parametrize("position_lost", [False, True])
@pytest.mark.parametrize("seed", first_quick(range(20), 2, 6))
def test_what_a_lost_change_retired_stays_retired(
    whole: Path, fleet: Fleet, seed: int, position_lost: bool, compacted: bool
):
    """Robots have dropped such changes together with what they undid: no disk has them any more."""
    _, maps = truth(whole)
    if compacted:
        store = SqliteStore(fleet.path)
        for map_id in maps:
            store.drop(map_id, [sequence for sequence, _ in store.superseded(map_id, 10_000)])
        store.close()
    rng = np.random.default_rng(2000 + seed)
    query = "SELECT agent, sequence FROM change WHERE kind IN ('NodeRetired', 'EdgeRetired') OR ?"
    with fleet.disk() as disk:
        rows = disk.execute(query, (seed % 2,)).fetchall()
        for k in rng.choice(len(rows), int(rng.integers(1, 9)), replace=False):
            disk.execute("UPDATE change SET crc = crc + 1 WHERE agent = ? AND sequence = ?", rows[k])
        if position_lost:
            disk.execute("UPDATE log SET crc = crc + 1")
    fleet.start()
    # Of a compacted map robots may keep what the store need not have.
    eventually(lambda: all_is_whole(fleet.store) and (compacted or fleet.lacks() == 0))
    assert all(replicator.wait_acknowledged(60) for replicator, _, _ in fleet.robots)
    fleet.stop()
    assert fleet.served() == maps
    fleet.start_server()
    assert fleet.served() == maps
    fleet.stop_server()


@pytest.mark.parametrize("seed", first_quick(range(60), 2, 20))
def test_a_flipped_bit_anywhere_is_repaired_or_reported_in_one_line(
    whole: Path, fleet: Fleet, seed: int, caplog
):
    logs, maps = truth(whole)
    rng = np.random.default_rng(1000 + seed)
    # Half of them where a page is described rather than filled: there a bit does most.
    size = fleet.path.stat().st_size
    inside = int(rng.integers(PAGE if seed % 2 else 60))
    flip(fleet.path, int(rng.integers(size // PAGE)) * PAGE + inside, int(rng.integers(8)))
    try:
        fleet.start_server()
    except InvalidFile as error:
        words = str(error)
        assert words.startswith(f"{fleet.path}: ") and "\n" not in words
        assert "mapweave map extract" in words or "is not a Mapweave" in words or "of format" in words
        return
    expected = {(one, k): data for one, log in logs.items() for k, data in enumerate(log, 1)}
    served = {(change.map, change.sequence): encode_change(change) for change in fleet.seen}
    assert served.items() <= expected.items()
    assert len(served) == len(expected) or "damaged" in caplog.text, "something is missing without a word"
    fleet.start_robots()
    eventually(lambda: all_is_whole(fleet.store) and fleet.lacks() == 0)
    for replicator, _, _ in fleet.robots:
        assert replicator.wait_acknowledged(30)
    fleet.stop()
    assert fleet.served() == maps


def without_journal(path: Path) -> bytes:
    """All that a database holds, in one file."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    return path.read_bytes()


def test_a_damaged_schema_that_is_no_text_is_reported_in_one_line(whole: Path, fleet: Fleet):
    """SQLite quotes it in its error, which then is no text; found by fuzzing."""
    data = without_journal(fleet.path)
    assert b"tableloglog" in data and b"CREATE TABLE log " in data
    data = data.replace(b"tableloglog", b"table\x95\x95glog").replace(
        b"CREATE TABLE log ", b"CREATE TABLX log "
    )
    fleet.path.write_bytes(data)
    with pytest.raises(InvalidFile, match="damaged") as caught:
        SqliteStore(fleet.path)
    assert "\n" not in str(caught.value)


def test_a_damaged_schema_with_a_line_break_is_reported_in_one_line(fleet: Fleet):
    """SQLite quotes it as it is; found by fuzzing a journal."""
    path = fleet.folder / "r0"
    data = without_journal(path)
    assert data.count(b"server TEXT NOT NULL") == 1
    path.write_bytes(data.replace(b"server TEXT NOT NULL", b'server TEXT NOT "\nLL'))
    with pytest.raises(InvalidFile, match="agent journal is damaged") as caught:
        Journal(path)
    assert "\n" not in str(caught.value)


def test_the_state_of_a_log_may_be_lost(whole: Path, fleet: Fleet, caplog):
    """Its robot may not be there: its map is served all the same, and its log goes on when it comes."""
    logs, maps = truth(whole)
    with fleet.disk() as disk:
        disk.execute("UPDATE log SET watermark = 5, log_id = '17' WHERE agent = 'r1'")
    fleet.start_server()
    assert fleet.stored() == logs and fleet.served() == maps
    assert "the position of r1.1 was damaged; its log is pulled from the beginning" in caplog.text
    fleet.start_robots()
    eventually(lambda: fleet.store.watermark(MapId("r1", 1)) == len(logs[MapId("r1", 1)]))
    fleet.stop()
    assert fleet.served() == maps


def test_damage_is_remembered_until_the_robot_comes(fleet: Fleet):
    with fleet.disk() as disk:
        disk.execute("UPDATE change SET crc = crc + 1 WHERE agent = 'r1' AND sequence IN (3, 4, 9)")
    for _ in range(2):
        fleet.start_server()
        assert [(gap.first, gap.last) for gap in fleet.store.damaged(MapId("r1", 1))] == [(3, 4), (9, 9)]
        assert fleet.store.damaged(MapId("r0", 1)) == []
        fleet.stop_server()


@pytest.mark.parametrize("bit", first_quick(range(8), 3))
def test_a_damaged_key_misleads_no_reader(whole: Path, fleet: Fleet, bit: int):
    """A row that claims to be of another map: what it was stands between its neighbours."""
    logs, maps = truth(whole)
    one = MapId("r1", 1)
    sequence, body = next((k, body) for m, k, body in bodies_in(fleet.path) if m == one and len(body) > 999)
    data = fleet.path.read_bytes()
    flip(fleet.path, data.rindex(b"r1", 0, data.index(body[:40])), bit)
    fleet.start_server()
    assert fleet.store.maps() == sorted(logs)
    assert [(gap.map, gap.first, gap.last) for gap in fleet.store.damaged()] == [(one, sequence, sequence)]
    assert len(fleet.seen) == sum(map(len, logs.values())) - 1
    fleet.start_robots()
    eventually(lambda: all_is_whole(fleet.store))
    fleet.stop()
    assert fleet.served() == maps


def test_a_change_that_this_program_cannot_read_costs_only_itself(fleet: Fleet, caplog):
    which = "WHERE agent = 'r1' AND sequence = 6"
    with fleet.disk() as disk:
        row = disk.execute(f"SELECT * FROM change {which}").fetchone()
        values = (*row[:7], b"\xc1 of a newer program")
        disk.execute(f"UPDATE change SET body = ?, crc = ? {which}", (values[7], checksum(values)))
    fleet.start_server()
    assert 6 not in {change.sequence for change in fleet.seen if change.map.agent == "r1"}
    assert "change 6 of r1.1 cannot be read" in caplog.text
    fleet.stop_server()


def test_a_damaged_constraint_costs_only_itself(fleet: Fleet, caplog):
    with fleet.disk() as disk:
        disk.execute("UPDATE manual_constraint SET body = body || x'00' WHERE number = 2")
    with closing(SqliteStore(fleet.path)) as store:
        made = ConstraintRecord(store).constraints.made
    assert [constraint.stamp_ns for constraint in made] == [0, 2, 3, 4]
    assert "1 damaged rows of table manual_constraint" in caplog.text


def test_the_number_of_constraints_is_limited(fleet: Fleet, monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.log.store.MAX_CONSTRAINTS", 7)
    store = SqliteStore(fleet.path)
    book = ConstraintRecord(store)
    constraint = book.constraints.made[0]
    for k in range(2):
        book.add(replace(constraint, stamp_ns=100 + k))
    with pytest.raises(InvalidValue, match="the record of manual constraints is full: 7"):
        book.add(constraint)
    assert len(book.constraints.made) == 7
    store.close()
    store = SqliteStore(fleet.path)
    assert ConstraintRecord(store).constraints.made == book.constraints.made
    store.close()


def test_a_store_with_broken_pages_is_extracted(whole: Path, fleet: Fleet, capfd):
    """One line says what is wrong and what to do; what the line says works."""
    _, maps = truth(whole)
    size = fleet.path.stat().st_size
    data = bytearray(fleet.path.read_bytes())
    # A leaf of an index, as SQLite keeps tables without row ids: what lies in an overflow page can be healed.
    leaves = [at for at in range(0, size, PAGE) if data[at] == 0x0A and len(set(data[at : at + PAGE])) > 99]
    middle = leaves[len(leaves) // 2]
    data[middle : middle + PAGE] = np.random.default_rng(3).bytes(PAGE)
    fleet.path.write_bytes(bytes(data))
    assert main(["server", "--data", str(fleet.folder), "--listen", f"tcp/127.0.0.1:{free_port()}"]) == 1
    output = capfd.readouterr().err.splitlines()
    assert len(output) == 1 and "is damaged (" in output[0]
    assert "`mapweave map extract FILE -o FOLDER`" in output[0]
    out = fleet.folder / "out"
    assert main(["map", "extract", str(fleet.path), "-o", str(out)]) == 1
    assert "pages that cannot be read" in capfd.readouterr().err
    kept = 0
    for path in out.iterdir():
        kept += sum(isinstance(body, NodePut) for body in read_map_file(path).changes)
    assert kept > 0.8 * sum(len(HybridMap(journal_bodies(whole, one)).nodes) for one in maps)
    fleet.path.rename(fleet.folder / "away")
    fleet.start()
    eventually(lambda: set(fleet.store.maps()) == set(maps) and fleet.lacks() == 0)
    fleet.stop()
    assert fleet.served() == maps


def extracted(fleet: Fleet, maps: Iterable[MapId]) -> dict[MapId, list[bytes]]:
    files = {one: read_map_file(fleet.folder / "out" / f"{one}.mapweave") for one in maps}
    return {one: sorted(map(encode_body, content.changes)) for one, content in files.items()}


@pytest.mark.parametrize("table", ["refused", "result", "damaged"])
def test_a_store_whose_description_of_a_table_is_damaged_is_extracted(
    whole: Path, fleet: Fleet, capfd, table: str
):
    """SQLite reads nothing of it by itself, also no other table."""
    _, maps = truth(whole)
    data = fleet.path.read_bytes()
    assert data.count(f"CREATE TABLE {table}".encode()) == 1
    fleet.path.write_bytes(data.replace(f"CREATE TABLE {table}".encode(), f"CREATE TABLF {table}".encode()))
    assert main(["map", "extract", str(fleet.path), "-o", str(fleet.folder / "out")]) == 1
    assert "pages that cannot be read" in capfd.readouterr().err
    assert extracted(fleet, maps) == maps


def test_a_whole_store_is_extracted_whole(whole: Path, fleet: Fleet, capfd):
    _, maps = truth(whole)
    before = fleet.path.read_bytes()
    assert main(["map", "extract", str(fleet.path), "-o", str(fleet.folder / "out")]) == 0
    assert capfd.readouterr().err == "" and fleet.path.read_bytes() == before
    assert extracted(fleet, maps) == maps
    for path, words in (
        (fleet.folder / "nothing", "no such file"),
        (Path(__file__), "is neither a map file"),
    ):
        assert main(["map", "extract", str(path), "-o", str(fleet.folder / "out")]) == 1
        assert words in capfd.readouterr().err
