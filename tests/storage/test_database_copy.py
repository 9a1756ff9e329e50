"""Copies of SQLite files that a process writes to; and which process such a file belongs to."""

import json
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.database import Database
from mapweave.storage.database_copy import copying
from mapweave.storage.file_owner import is_owned, lock_of, owning
from tests.disks import own_mounts

SCHEMA = "CREATE TABLE line (number INTEGER PRIMARY KEY, body BLOB)"
OPEN = ("notebook", 77, 1, SCHEMA)


@pytest.fixture
def notes(tmp_path: Path) -> Iterator[Database]:
    database = Database(tmp_path / "notes.sqlite", *OPEN)
    with closing(database):
        yield database


def write(database: Database, count: int) -> None:
    with database.transaction() as rows:
        rows.executemany("INSERT INTO line (body) VALUES (?)", [(bytes(2000),)] * count)


def lines(path: Path) -> int:
    with closing(Database(path, *OPEN, read_only=True)) as copy:
        return int(copy.connection.execute("SELECT count(*) FROM line").fetchone()[0])


def test_a_copy_is_of_one_moment_while_its_owner_writes_on(notes: Database, tmp_path):
    write(notes, 3000)
    seen: list[int] = []

    def progress(done: int, of: int) -> None:
        # Of an owner that commits amid each step nothing waits, and nothing starts again.
        seen.append(done)
        write(notes, 5)
        assert len(seen) < 20

    with copying(notes.path, tmp_path / "copy", progress):
        pass
    assert len(seen) > 1 and seen == sorted(seen)
    assert lines(tmp_path / "copy") == 3000
    assert notes.connection.execute("SELECT count(*) FROM line").fetchone()[0] == 3000 + 5 * len(seen)
    assert sorted(path.name for path in tmp_path.glob("*copy*")) == ["copy"]


def test_a_file_that_no_process_has_open_is_copied_and_not_changed(notes: Database, tmp_path):
    write(notes, 10)
    notes.close()
    notes.path.chmod(0o600)
    before = notes.path.read_bytes(), sorted(tmp_path.iterdir())
    with copying(notes.path, tmp_path / "copy"):
        assert not (tmp_path / "copy").exists(), "it has its name once all is well"
    assert (notes.path.read_bytes(), sorted({*tmp_path.iterdir()} - {tmp_path / "copy"})) == before
    assert (tmp_path / "copy").stat().st_mode & 0o777 == 0o600
    with closing(Database(tmp_path / "copy", *OPEN)) as again:
        write(again, 1)
    assert (lines(tmp_path / "copy"), lines(notes.path)) == (11, 10)


def test_nothing_is_written_over_and_nothing_half_done_stays(notes: Database, tmp_path):
    write(notes, 10)
    there = tmp_path / "there"
    there.write_text("mine")
    words = "there: is there already, and is not written over"
    with pytest.raises(InvalidFile, match=words), copying(notes.path, there):
        pass
    late = tmp_path / "late"
    with pytest.raises(InvalidFile, match="is there already"), copying(notes.path, late):
        late.write_text("mine")
    assert there.read_text() == late.read_text() == "mine"
    for target in (tmp_path / "nowhere" / "copy", tmp_path):
        with pytest.raises(InvalidFile, match="cannot be written"), copying(notes.path, target):
            pass
    none, copy = tmp_path / "none", tmp_path / "copy"
    with pytest.raises(InvalidFile, match="none: no such file"), copying(none, copy):
        pass
    with pytest.raises(KeyboardInterrupt), copying(notes.path, tmp_path / "copy"):
        raise KeyboardInterrupt
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith("notes")}
    assert left == {"there", "late"}


def test_a_damaged_file_is_not_taken_for_a_backup(notes: Database, tmp_path):
    write(notes, 500)
    notes.close()
    data = bytearray(notes.path.read_bytes())
    data[4096 * 100 : 4096 * 102] = b"\xaa" * 8192
    notes.path.write_bytes(data)
    with (
        pytest.raises(InvalidFile, match=r"notes\.sqlite: is damaged .*map extract") as error,
        copying(notes.path, tmp_path / "copy"),
    ):
        pass
    assert "\n" not in str(error.value) and not list(tmp_path.glob("*copy*"))


def test_a_file_belongs_to_one_owner_which_may_be_read(notes: Database, tmp_path):
    write(notes, 1)
    with pytest.raises(InvalidFile, match="is in use by another process; stop it first"):
        Database(notes.path, *OPEN)
    with pytest.raises(InvalidFile, match=r"is in use by another process.*map backup"):
        lines(notes.path)
    program = (
        f"import sqlite3; c = sqlite3.connect('file:{notes.path}?mode=ro', uri=True)\n"
        "print(c.execute('SELECT count(*) FROM line').fetchone()[0])"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "1\n"
    notes.close()
    assert [path.name for path in tmp_path.iterdir()] == ["notes.sqlite"], "neither lock nor log stays"


def test_an_owner_that_is_killed_owns_no_longer_and_its_last_commits_are_copied(tmp_path):
    path = tmp_path / "notes.sqlite"
    program = (
        "import os, sys; from pathlib import Path\n"
        "from tests.storage.test_database_copy import OPEN, Database, write\n"
        "notes = Database(Path(sys.argv[1]), *OPEN); write(notes, 7); os._exit(0)\n"
    )
    command = [sys.executable, "-c", program, str(path)]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    assert lock_of(path).exists() and not is_owned(path)
    with copying(path, tmp_path / "copy"):
        pass
    assert lines(tmp_path / "copy") == 7
    with closing(Database(path, *OPEN)) as again:
        write(again, 1)
    assert lines(path) == 8


def test_among_many_that_want_a_file_there_is_one_owner_at_a_time(tmp_path):
    path, inside, most, turns = tmp_path / "file", [0], [0], [0]

    def want() -> None:
        for _ in range(20):
            with owning(path, 60.0):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                turns[0] += 1
                inside[0] -= 1

    threads = [threading.Thread(target=want) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (turns[0], most[0]) == (80, 1)
    assert not lock_of(path).exists()


FULL = """
import json, subprocess, sys
from pathlib import Path
from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.database_copy import copying
from tests.disks import empty, fill, mount
from tests.storage.test_database_copy import OPEN, Database, lines, write

root, said = Path(sys.argv[1]), {}
def refused(source, target):
    try:
        with copying(source, target):
            return ""
    except InvalidFile as error:
        return str(error)

notes = Database(root / "notes.sqlite", *OPEN)
write(notes, 5000)
small = mount(root / "small", "1m")
said["small"], said["left"] = refused(notes.path, small / "copy"), [p.name for p in small.iterdir()]
# The disk fills up amid the copy.
large, steps = mount(root / "large", "16m"), []
def progress(done, of):
    steps.append(done)
    fill(large)
try:
    with copying(notes.path, large / "copy", progress):
        pass
except InvalidFile as error:
    said["large"] = str(error)
said["left there"] = [p.name for p in large.iterdir()]
# A file on a disk without room for what is shared with readers is opened, and belongs to its owner alone.
crowded = mount(root / "crowded", "8m")
own = Database(crowded / "own.sqlite", *OPEN)
write(own, 3)
own.close()
fill(crowded)
own = Database(crowded / "own.sqlite", *OPEN)
said["read"] = own.connection.execute("SELECT count(*) FROM line").fetchone()[0]
program = (
    "import sys; from pathlib import Path; from mapweave.hybridmap.errors import InvalidFile\\n"
    "from tests.storage.test_database_copy import OPEN, Database, copying\\n"
    "for use in (lambda p: Database(p, *OPEN), lambda p: copying(p, Path(sys.argv[2])).__enter__()):\\n"
    "    try: use(Path(sys.argv[1])); print('taken')\\n"
    "    except InvalidFile as error: print(error)\\n"
)
command = [sys.executable, "-c", program, str(own.path), str(root / "copy")]
said["others"] = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
empty(crowded)
write(own, 1)
own.close()
said["after"] = lines(own.path)
print(json.dumps(said))
"""


@pytest.mark.slow
def test_full_disks_are_named_and_left_as_they_were(tmp_path):
    command = [*own_mounts(), sys.executable, "-c", FULL, str(tmp_path)]
    root = Path(__file__).parents[2]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=root)
    assert ran.returncode == 0, ran.stderr
    said = json.loads(ran.stdout)
    for name in ("small", "large"):
        assert said[name].endswith(
            "copy: cannot be written (the disk is full; make room, or give a place on another disk)"
        )
    assert (said["left"], said["left there"]) == ([], ["ballast"])
    assert (said["read"], said["after"]) == (3, 4)
    for line in said["others"]:
        assert "in use by" in line


def test_a_program_that_writes_into_the_file_of_an_owner_is_waited_for(notes: Database):
    write(notes, 1)
    with closing(sqlite3.connect(notes.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(InvalidFile, match="in use by another process"):
            write(notes, 1)
        other.execute("ROLLBACK")
    write(notes, 1)
    assert notes.connection.execute("SELECT count(*) FROM line").fetchone()[0] == 2
