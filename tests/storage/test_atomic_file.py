"""The old file or the new one, never a part of either."""

import errno
import fcntl
import os
import resource
import signal
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage import atomic_file
from mapweave.storage.atomic_file import check_place, state_of, unchanged_since, write_whole
from mapweave.storage.file_owner import owning
from mapweave.storage.first_bytes import MAP_FILE, SQLITE


@contextmanager
def small_files() -> Iterator[None]:
    """A disk that takes 1000 bytes a file. Keep it short: what pytest prints may go to a file, too."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    # Python would keep bytecode that is cut off.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    path = tmp_path / "x"
    write_whole(path, b"old")
    refused = pytest.raises(InvalidFile, match=r"x: cannot be written \(File too large\)")
    with refused, small_files():
        write_whole(path, b"new" * 1000)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "x"
    write_whole(path, b"old")

    def interrupted(handle: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_a_link_to_a_file_stays_a_link(tmp_path):
    path, link = tmp_path / "x", tmp_path / "link"
    path.write_bytes(b"old")
    link.symlink_to(path)
    write_whole(link, b"new")
    assert link.is_symlink() and path.read_bytes() == b"new"


def test_a_pipe_is_written_into(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(pipe, b"new")
        assert os.read(reader, 100) == b"new" and pipe.is_fifo()
    finally:
        os.close(reader)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("", "Is a directory"),
        ("nowhere/x", "there is no folder .*nowhere"),
        ("file/x", "there is no folder .*file"),
    ],
)
def test_places_where_no_file_can_be(tmp_path, place: str, words: str):
    (tmp_path / "file").write_bytes(b"")
    for path in (tmp_path / place, Path("." if not place else f"{tmp_path}/{place}")):
        with pytest.raises(InvalidFile, match=words):
            check_place(path)
        with pytest.raises(InvalidFile, match=words):
            write_whole(path, b"new")


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (SQLITE + b"\x10\x00", "a server's store or an agent's journal is there; give another name"),
        (MAP_FILE + b"\x01", "a map file is there; give another name"),
    ],
)
def test_what_robots_have_made_is_not_written_over_with_something_else(there: bytes, words: str, tmp_path):
    path = tmp_path / "x"
    path.write_bytes(there)
    for data in (b"a picture", b"", memoryview(b"a picture")):
        with pytest.raises(InvalidFile) as refused:
            write_whole(path, data)
        assert str(refused.value) == f"{path}: cannot be written ({words})"
    assert path.read_bytes() == there and list(tmp_path.iterdir()) == [path]


def test_a_newer_map_takes_the_place_of_a_map_and_of_no_other_file(tmp_path):
    path, newer = tmp_path / "x", MAP_FILE + b"\x02"
    path.write_bytes(MAP_FILE + b"\x01")
    write_whole(path, newer)
    write_whole(path, memoryview(newer))
    assert path.read_bytes() == newer
    for there, words in ((SQLITE, "store"), (b"a photograph", "a file that is no map is there; give")):
        path.write_bytes(there)
        with pytest.raises(InvalidFile, match=words):
            write_whole(path, newer)
        assert path.read_bytes() == there
    path.write_bytes(b"")
    write_whole(path, newer)
    assert path.read_bytes() == newer


def test_a_disk_that_is_read_only_is_named_with_the_file_itself(tmp_path, monkeypatch):
    """Not with the temporary file, which cannot be removed there either."""
    path = tmp_path / "x"
    write_whole(path, b"old")

    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "write_bytes", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    with pytest.raises(InvalidFile, match=r"/x: cannot be written \(the disk is read-only; "):
        write_whole(path, b"new")


def test_a_share_that_locks_no_folders_takes_changes(tmp_path, monkeypatch):
    """NFS locks only what is open for writing, which no folder is."""
    path, flock = tmp_path / "a.mapweave", fcntl.flock
    write_whole(path, b"before")

    def as_nfs(handle: int, operation: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EBADF, "Bad file descriptor")
        flock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", as_nfs)
    with unchanged_since(path, state_of(path)):
        write_whole(path, b"after")
    assert path.read_bytes() == b"after" and [*tmp_path.iterdir()] == [path]


def test_who_waits_in_vain_for_another_command_changes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic_file, "PATIENCE", 0.05)
    path = tmp_path / "a.mapweave"
    write_whole(path, b"before")
    with (
        owning(path, 0.0),
        pytest.raises(InvalidFile, match="another command is writing it"),
        unchanged_since(path, state_of(path)),
    ):
        write_whole(path, b"after")
    assert path.read_bytes() == b"before"
