"""A full disk is one line of the log, and so is that it has room again, however much is written to it."""

import errno
import os
from contextlib import closing
from pathlib import Path

import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage import database, full_disks
from mapweave.storage.atomic_file import write_whole
from mapweave.storage.database import Database
from mapweave.storage.full_disks import FullDisk, logged, written

SCHEMA = "CREATE TABLE line (number INTEGER PRIMARY KEY, body BLOB)"
WORDS = "a file cannot be written"


@pytest.fixture(autouse=True)
def disks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two disks, none of which this process knows to be full."""
    monkeypatch.setattr(full_disks, "_full_disks", full_disks._FullDisks())
    for name in ("one", "other"):
        (tmp_path / name / "folder").mkdir(parents=True)
    mounts = {tmp_path / "one", tmp_path / "other", Path("/")}
    monkeypatch.setattr(os.path, "ismount", lambda folder: Path(folder) in mounts)


def full(path: Path) -> FullDisk:
    return FullDisk.of_file(f"{path}: {WORDS}", path)


def test_each_disk_is_one_line_until_it_has_room(tmp_path, caplog):
    store, cache = tmp_path / "one" / "folder" / "s0.sqlite", tmp_path / "one" / "s0.sqlite.verdicts"
    elsewhere = tmp_path / "other" / "notes"
    for path in (store, cache, store, elsewhere, cache):
        assert logged(full(path))
    # What was not written before says nothing of what could not be.
    written(tmp_path / "one" / "small")
    assert caplog.messages == [
        f"{path}: the disk is full (mounted at {disk}); make room, and what waits is written"
        for path, disk in ((store, tmp_path / "one"), (elsewhere, tmp_path / "other"))
    ]
    caplog.clear()
    for path in (cache, store, cache):
        written(path)
    assert caplog.messages == [f"{cache}: the disk has room again; what waited is written"]
    assert logged(full(store)) and len(caplog.messages) == 2, "it is full once more"


def test_other_errors_are_the_callers_to_log(caplog):
    assert not logged(InvalidFile("damaged")) and not caplog.messages


def test_a_database_that_takes_a_little_now_and_then_has_no_room_yet(monkeypatch, caplog):
    """Its pages have room for one change where its disk has none for ten: each was two lines of the log."""
    now = [0.0]
    monkeypatch.setattr(full_disks, "_full_disks", full_disks._FullDisks(lambda: now[0]))
    for now[0] in (0.0, 0.9, 1.8):
        assert logged(FullDisk.of_database("postgresql://host/maps: no space", "postgresql://host/maps"))
        written("postgresql://host/maps", full_disks.CALM)
    now[0] += 1.1 * full_disks.CALM
    for _ in range(2):
        written("postgresql://host/maps", full_disks.CALM)
    assert caplog.messages == [
        "postgresql://host/maps: no space",
        "postgresql://host/maps: the disk has room again; what waited is written",
    ]


def test_a_database_on_a_full_disk_says_so_and_that_it_is_written_again(tmp_path, monkeypatch, caplog):
    """A change that fits into a page that it has is written in between, and says nothing of the disk."""
    now = [0.0]
    monkeypatch.setattr(full_disks, "_full_disks", full_disks._FullDisks(lambda: now[0]))
    path = tmp_path / "one" / "notes.sqlite"
    with closing(Database(path, "notebook", 77, 1, SCHEMA)) as notes:
        monkeypatch.setattr(database, "LEAST_FREE", 1 << 62)
        (pages,) = notes.connection.execute("PRAGMA page_count").fetchone()
        notes.connection.execute(f"PRAGMA max_page_count={pages}")
        for number in range(2):
            with (
                pytest.raises(FullDisk, match=r"notebook: the disk is full") as error,
                notes.transaction() as run,
            ):
                run.execute("INSERT INTO line VALUES (1, zeroblob(100000))")
            assert logged(error.value)
            with notes.transaction() as run:
                run.execute("INSERT INTO line VALUES (?, 'small')", (10 + number,))
        now[0] += 1.1 * full_disks.CALM
        notes.connection.execute("PRAGMA max_page_count=1000")
        for number in range(2):
            with notes.transaction() as run:
                run.execute("INSERT INTO line VALUES (?, zeroblob(100000))", (number,))
    assert [line.split("; ")[0] for line in caplog.messages] == [
        f"{path}: the disk is full (mounted at {tmp_path / 'one'})",
        f"{path}: the disk has room again",
    ]


def test_a_file_on_a_full_disk_says_so_and_that_it_is_written_again(tmp_path, caplog):
    path = tmp_path / "one" / "file"

    def no_room(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(FullDisk, match="the disk is full") as error:
        patch.setattr(os, "fsync", no_room)
        write_whole(path, b"content")
    assert logged(error.value) and not path.exists()
    write_whole(path, b"content")
    assert len(caplog.messages) == 2 and path.read_bytes() == b"content"
