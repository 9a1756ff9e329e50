"""Changes of a folder of keys: by one process at a time, and whole or not at all."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError
from mapweave.storage.os_errors import reason_of


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Wait until no other process changes the folder, and hold the lock; a process that ends releases it.

    The folder itself is locked: a file for that would have to be writable by root and by the server's user.

    Raises:
        SettingsError: it is missing, or no folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:
        raise SettingsError(f"{folder}: no keys are here; make some with `mapweave keys init`") from None
    except OSError as error:
        raise SettingsError(f"{folder}: {reason_of(error)}") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


@contextmanager
def kept_on_failure(*paths: Path) -> Iterator[None]:
    """Put files back as they were if what is done fails; on a full disk a name is left, but no room."""
    before = {path: path.with_name(f".{path.name}.before") for path in paths}
    for path, kept in before.items():
        kept.unlink(missing_ok=True)
        if path.exists():
            os.link(path, kept)
    try:
        yield
    except BaseException:
        for path, kept in before.items():
            if kept.exists():
                kept.replace(path)
            else:
                path.unlink(missing_ok=True)
        raise
    finally:
        # Also behind a failure: two names of one file are left by a replacement.
        for kept in before.values():
            kept.unlink(missing_ok=True)
