"""Files that are written whole or not at all: a full disk or a loss of power leaves the old one.

Only regular files are read: a device or a pipe may have no end.
"""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.file_owner import owning
from mapweave.storage.first_bytes import MAP_FILE, SQLITE
from mapweave.storage.full_disks import FullDisk, written
from mapweave.storage.os_errors import NO_ROOM, READ_ONLY, no_permission, reason_of


def write_whole(path: Path, data: bytes | memoryview) -> None:
    """Write a temporary file in the same folder, then rename it.

    Raises:
        InvalidFile: the disk does not take it, or a database is there, or of a map file and another file one
            is there and this is the other; what was there is as before.
    """
    if data[: len(MAP_FILE)] == MAP_FILE:
        check_map_place(path)
    else:
        check_place(path)
        if _begins(path, MAP_FILE):
            raise unwritable(path, "a map file is there; give another name")
    if path.exists() and not path.is_file():
        # A pipe, a terminal, /dev/null: nothing to keep, and nothing to put in its place.
        path.write_bytes(data)
        return
    with replacing(path) as beside:
        beside.write_bytes(data)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path in the same folder, whose file takes the place of `path` at the end, or is removed on an error.

    Raises:
        InvalidFile: the disk does not take it; what was there is as before.
    """
    path = path.resolve()
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(path)
        _sync_folder(path.parent)
        written(path)
    except OSError as error:
        _remove(beside)
        raise unwritable(path, reason_of(error)) from None
    except BaseException:
        # Interrupted: remove the temporary file.
        _remove(beside)
        raise


State = tuple[int, int, int]
"""Of a file: differs once it was replaced."""
PATIENCE = 20.0
"""s; for another command to write a map file."""


def state_of(path: Path) -> State | None:
    """The state of a file; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


@contextmanager
def unchanged_since(path: Path, state: State | None) -> Iterator[None]:
    """Within it a file can be replaced by what was made of its content in that state.

    Raises:
        InvalidFile: the file is another one since, another command keeps it, or its folder takes no lock.
    """
    try:
        with owning(path.resolve(), PATIENCE):
            if state_of(path) != state:
                raise InvalidFile(
                    f"{path}: another command has written it meanwhile, and it is kept: say it again"
                )
            yield
    except BlockingIOError:
        raise InvalidFile(f"{path}: another command is writing it; say it again") from None
    except OSError as error:
        raise unwritable(path, reason_of(error)) from None


def read_whole(path: Path) -> bytes:
    """Read a regular file.

    Raises:
        OSError: it is missing, cannot be read, or is a device or a pipe.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return path.read_bytes()


def check_place(path: Path) -> None:
    """Refuse a place where no file can be, before hours of work are written there.

    Raises:
        InvalidFile: it is a folder or a database, or its folder is missing or takes no files.
    """
    if path.is_dir() or not path.name:
        raise unwritable(path, os.strerror(errno.EISDIR))
    if not path.parent.is_dir():
        raise unwritable(path, f"there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK) and not path.exists():
        read_only = os.statvfs(path.parent).f_flag & os.ST_RDONLY
        raise unwritable(path, READ_ONLY if read_only else no_permission())
    if _begins(path, SQLITE):
        raise unwritable(path, "a server's store or an agent's journal is there; give another name")


def check_map_place(path: Path) -> None:
    """Refuse a place where no map file can be: a photograph or a program has no copy, and a map one.

    Raises:
        InvalidFile: see `check_place`; or a file is there that is neither a map nor empty.
    """
    check_place(path)
    if path.is_file() and path.stat().st_size and not _begins(path, MAP_FILE):
        raise unwritable(path, "a file that is no map is there; give another name")


def _remove(path: Path) -> None:
    """Remove a file, where that is possible: a disk that is read-only keeps what it has."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _begins(path: Path, first: bytes) -> bool:
    """Whether a regular file that can be read begins with these bytes."""
    try:
        # To open a pipe would wait for who writes into it.
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(len(first)) == first
    except OSError:
        return False


def unwritable(path: Path, why: str) -> InvalidFile:
    """The error of a file that cannot be written, with why."""
    words = f"{path}: cannot be written ({why})"
    return FullDisk.of_file(words, path) if why == NO_ROOM else InvalidFile(words)


def _sync_folder(folder: Path) -> None:
    """Make a move in a folder outlast a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
