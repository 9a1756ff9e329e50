"""Files that only one command at a time replaces, also on a network share."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from pathlib import Path

import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage import atomic_file
from mapweave.storage.atomic_file import state_of, unchanged_since, write_whole
from mapweave.storage.file_owner import owning


def test_a_share_that_locks_no_folders_takes_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_who_waits_in_vain_for_another_command_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
