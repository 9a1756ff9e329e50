"""The process that a file belongs to, while others may read the file."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

STEP = 0.02
"""s; between two looks at a lock that another process holds."""


@contextmanager
def owning(path: Path, patience: float) -> Iterator[None]:
    """Within it a file belongs to this process, as long as all its owners ask in this way.

    The lock is on an empty file beside it, which is removed at the end: to close a file drops all locks that
    SQLite holds on it. The kernel releases the lock of a process that dies.

    Args:
        path: of the file, which need not be there.
        patience: how long to wait for another owner, s.

    Raises:
        BlockingIOError: it belongs to another owner, in this process or another one.
        OSError: the folder takes no such file.
    """
    beside = lock_of(path)
    end = time.monotonic() + patience
    while (handle := _locked(beside)) is None:
        if time.monotonic() >= end:
            raise BlockingIOError(f"{path}: belongs to another process")
        time.sleep(STEP)
    try:
        yield
    finally:
        # Before the lock is released: who waits for it then looks whether it is still this file.
        with suppress(OSError):
            beside.unlink()
        os.close(handle)


def is_owned(path: Path) -> bool:
    """Whether a file belongs to some owner now. Makes no file."""
    try:
        handle = os.open(lock_of(path), os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False


def lock_of(path: Path) -> Path:
    """The file with the lock of a file."""
    return path.with_name(f"{path.name}-lock")


def _locked(beside: Path) -> int | None:
    """A handle of the lock file that holds its lock; None if another one holds it."""
    handle = os.open(beside, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(handle), beside.stat()):
            return handle
    except (BlockingIOError, FileNotFoundError):
        # Held, or removed by its last owner just now.
        pass
    except BaseException:
        os.close(handle)
        raise
    os.close(handle)
    return None
