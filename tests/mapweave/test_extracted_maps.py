"""What `map extract` gets out of journals and stores, whole and damaged."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import psycopg
import pytest

from mapweave import HybridMap, MapId, NodeId, read_map_file
from mapweave.agent.replication import salvage
from mapweave.agent.replication.journal import Journal
from mapweave.cli import main
from mapweave.exit_status import FAILED, NO
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.sqlite_store import SqliteStore
from synthetic.maps import write_store
from tests.agent.replication.test_damaged_journal import MAP, log_of
from tests.mapweave.command_line import complaint
from tests.mapweave.test_cli_files import one_node


def journal_with(path: Path, *epochs: int) -> Path:
    """A journal with maps of one node; epoch 9 stays empty."""
    journal = Journal(path, "r0")
    for epoch in epochs:
        map_id = journal.open_map(epoch)
        if epoch != 9:
            journal.append(map_id, [renumbered(epoch)], 0)
    journal.close()
    return path


def renumbered(epoch: int):
    (put,) = one_node()
    return replace(put, node=replace(put.node, id=NodeId("r0", epoch, 1)))


def test_maps_of_a_journal_are_extracted_and_no_file_is_written_over(tmp_path, capfd):
    source = journal_with(tmp_path / "r0.sqlite", 1, 4, 9)
    assert main(["map", "extract", str(source), "-o", str(tmp_path / "out")]) == 0
    output = capfd.readouterr().out
    assert f"{tmp_path / 'out' / 'r0.4.mapweave'}: 1 node, 0 edges" in output
    assert "r0.9: empty, not written" in output
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["r0.1.mapweave", "r0.4.mapweave"]
    (tmp_path / "out" / "r0.1.mapweave").unlink()
    kept = tmp_path / "out" / "r0.4.mapweave"
    kept.write_bytes(b"mine")
    output = complaint(capfd, "map", "extract", source, "-o", tmp_path / "out")
    assert "r0.4.mapweave: is there already; choose another folder with -o" in output
    assert kept.read_bytes() == b"mine"
    assert not (tmp_path / "out" / "r0.1.mapweave").exists(), "all or nothing"


def test_other_files_and_files_in_use_are_named(tmp_path, capfd):
    assert "no such file" in complaint(capfd, "map", "extract", tmp_path / "none")
    other = tmp_path / "other.txt"
    other.write_text("no database at all")
    assert "other.txt: is neither a map file" in complaint(capfd, "map", "extract", other)
    path = tmp_path / "r0.sqlite"
    journal = Journal(path, "r0")
    try:
        assert "is in use by another process" in complaint(capfd, "map", "extract", path)
    finally:
        journal.close()
    empty = tmp_path / "empty.sqlite"
    empty.write_bytes(b"")
    assert "nor an agent's journal nor a server's store" in complaint(capfd, "map", "extract", empty)


def test_where_there_is_no_map_the_answer_is_no_and_no_user_is_named(tmp_path, capfd, postgres):
    SqliteStore(tmp_path / "s0.sqlite").close()
    assert main(["map", "extract", str(tmp_path / "s0.sqlite"), "-o", str(tmp_path / "out")]) == NO
    assert capfd.readouterr().out == f"{tmp_path / 's0.sqlite'}: holds no map\n"
    address = postgres.database()
    PostgresStore(address).close()
    assert main(["map", "extract", address, "-o", str(tmp_path / "out")]) == NO
    (said,) = capfd.readouterr().out.splitlines()
    assert said.endswith(": holds no map")
    login = psycopg.conninfo.conninfo_to_dict(address)
    assert address not in said and f"{login['user']}@" not in said and "user" not in said
    assert main(["map", "extract", address, "-o", str(tmp_path / "out"), "--json"]) == NO
    journal_with(tmp_path / "r0.sqlite")
    assert main(["map", "extract", str(tmp_path / "r0.sqlite"), "-o", str(tmp_path / "out")]) == NO


def test_readable_rows_of_a_store_are_extracted_and_the_rest_is_named(tmp_path, capfd):
    path = tmp_path / "s0.sqlite"
    write_store(path, {MapId("r0", epoch): [renumbered(epoch)] for epoch in (1, 2)})
    with sqlite3.connect(path) as rows:
        rows.execute("UPDATE change SET crc = crc + 1 WHERE epoch = 1")
    rows.close()
    assert main(["map", "extract", str(path), "-o", str(tmp_path / "out")]) == 1
    assert "damaged" in capfd.readouterr().err
    assert (tmp_path / "out" / "r0.2.mapweave").exists()


def test_what_is_left_of_a_damaged_journal_is_extracted_and_the_agent_says_how(tmp_path, capfd):
    path = tmp_path / "r0.sqlite"
    journal = Journal(path, "r0")
    map_id, (put,) = journal.open_map(1), one_node()
    nodes = [replace(put, node=replace(put.node, id=NodeId("r0", 1, k))) for k in range(1, 601)]
    journal.append(map_id, nodes, 0)
    journal.close()
    data = bytearray(path.read_bytes())
    # Leaves of the b-tree with changes; those of its index have more cells.
    pages = [page for page in range(0, len(data), 4096) if data[page] == 10 and data[page + 3] == 0]
    leaves = [page for page in pages if 10 < data[page + 4] < 100]
    # Two of them, so that what lies between them is reached from neither end.
    for page in (leaves[len(leaves) // 3], leaves[2 * len(leaves) // 3]):
        data[page : page + 4096] = bytes(4096)
    path.write_bytes(data)
    with pytest.raises(
        InvalidFile, match=r"agent journal is damaged \(.*\); save what can be read with `map"
    ):
        Journal(path, "r0")
    assert main(["map", "extract", str(path), "-o", str(tmp_path / "out")]) == 1
    assert f"mapweave: {path} had pages that cannot be read" in capfd.readouterr().err
    assert path.read_bytes() == data, "the file is not changed"
    left = HybridMap(read_map_file(tmp_path / "out" / "r0.1.mapweave", "agent").changes)
    missing = sorted(set(range(1, 601)) - {node.number for node in left.nodes})
    runs = [a for a, b in zip(missing, [*missing[1:], 0], strict=True) if b != a + 1]
    assert len(runs) == 2 and len(missing) < 100


def with_broken_pages(path: Path, *changes: tuple[int, int]) -> None:
    """Break the pages that have the changes, each given by epoch and sequence."""
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT body FROM change WHERE epoch = ? AND sequence = ?"
        bodies = [connection.execute(query, one).fetchone()[0] for one in changes]
    data = bytearray(path.read_bytes())
    for body in bodies:
        page = data.index(body) // 4096 * 4096
        data[page : page + 4096] = bytes(4096)
    path.write_bytes(data)


def two_maps(path: Path) -> Path:
    """A journal with two maps of 400 nodes."""
    journal, (put,) = Journal(path, "r0"), one_node()
    for epoch in (1, 2):
        nodes = [replace(put, node=replace(put.node, id=NodeId("r0", epoch, k))) for k in range(1, 401)]
        journal.append(journal.open_map(epoch), nodes, 0)
    journal.close()
    return path


def left_in(path: Path) -> list[list[int]]:
    """The nodes of each map of which nothing can be read."""
    maps = salvage.salvage(path).maps.values()
    known = [{node.number for node in HybridMap(kept.contents).nodes} for kept in maps]
    return [sorted(set(range(1, 401)) - one) for one in known]


def test_what_lies_between_damaged_pages_of_two_maps_is_read(tmp_path):
    """From neither end is the end of the first map reached, nor the begin of the second one."""
    path = two_maps(tmp_path / "r0.sqlite")
    with_broken_pages(path, (1, 100), (2, 300))
    first, second = left_in(path)
    assert 100 in first and 300 in second
    assert max(*map(len, (first, second)), first[-1] - first[0], second[-1] - second[0]) < 30


def test_a_damaged_number_does_not_make_a_salvage_endless(tmp_path, monkeypatch):
    """Each number below it would be looked up; those of maps that are as long as they say come first."""
    monkeypatch.setattr(salvage, "MOST_LOOKUPS", 1000)
    path = two_maps(tmp_path / "r0.sqlite")
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE change SET sequence = 1 << 60 WHERE epoch = 1 AND sequence = 400")
    with_broken_pages(path, (1, 100), (2, 100), (2, 300))
    first, second = left_in(path)
    assert 100 in first and {100, 300} <= set(second)
    assert len(first) < 30 and len(second) < 60


def test_a_journal_of_which_nothing_can_be_read_is_one_line(tmp_path, capfd):
    path = journal_with(tmp_path / "r0.sqlite", 1)
    data = path.read_bytes()
    path.write_bytes(data[:4096] + bytes(len(data) - 4096))
    assert "nothing can be read (" in complaint(capfd, "map", "extract", path, "-o", tmp_path / "out")


@pytest.mark.parametrize("share", [0.95, 0.75, 0.5, 0.3])
def test_of_a_journal_that_is_cut_off_all_whole_changes_come_back(share, tmp_path, capfd):
    """SQLite opens no file that is shorter than its header says: nothing came back."""
    path, log = tmp_path / "r0.sqlite", log_of(80)
    with closing(Journal(path, "r0")) as journal:
        journal.open_map(1)
        for body in log:
            journal.append(MAP, [body], 0)
        written = [row for _, row in journal.rows(MAP, 1, journal.head(MAP))]
    whole = path.read_bytes()
    cut = whole[: int(share * len(whole))]
    path.write_bytes(cut)
    # A node lies in up to two pages, in some order: it is whole if its first and last bytes are there.
    nodes = [row for row, body in zip(written, log, strict=True) if isinstance(body, NodePut)]
    there = sum(row[20:60] in cut and row[-60:] in cut for row in nodes)
    assert main(["map", "extract", str(path), "-o", str(tmp_path / "out")]) == FAILED
    assert f"the file is cut off: {len(cut)} of {len(whole)} bytes are there" in capfd.readouterr().err
    found = sum(
        isinstance(body, NodePut) for body in read_map_file(tmp_path / "out" / "r0.1.mapweave").changes
    )
    assert 0.8 * share * len(nodes) < there
    # The last node was retired.
    assert there - 1 <= found < len(nodes)
    assert path.read_bytes() == cut, "the file is as it was"


def test_of_a_file_that_ends_in_its_header_or_lacks_its_log_it_is_said_what_is_missing(tmp_path, capfd):
    path = journal_with(tmp_path / "r0.sqlite", 1)
    whole = path.read_bytes()
    path.write_bytes(whole[:1000])
    cut = f"nothing can be read (cut off: 1000 of {len(whole)} bytes are there)"
    assert cut in complaint(capfd, "map", "extract", path)
    path.unlink()
    with closing(Journal(path, "r0")) as journal:
        journal.open_map(1)
        killed = path.read_bytes()
    alone = tmp_path / "copy" / "r0.sqlite"
    alone.parent.mkdir()
    alone.write_bytes(killed)
    assert "what was written is in r0.sqlite-wal" in complaint(capfd, "map", "extract", alone)
