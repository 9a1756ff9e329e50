"""Changes of a folder of keys: by one process at a time, and whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError
from mapweave.identities.key_file import give_to_folders_owner
from mapweave.storage.file_owner import lock_of, owning
from mapweave.storage.os_errors import reason_of

PATIENCE = 20.0
"""s; for another command to change the keys, which takes it a fraction of a second."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Wait until no other process changes the folder, and hold the lock; a process that ends releases it.

    Raises:
        SettingsError: the folder is missing, is none or takes no file, or another process keeps the lock.
    """
    keys = folder / "keys"
    with ExitStack() as stack:
        try:
            stack.enter_context(owning(keys, PATIENCE))
            # Else the server's user could not change keys after a `sudo mapweave keys add` that was killed.
            give_to_folders_owner(lock_of(keys))
        except BlockingIOError:
            raise SettingsError(f"{folder}: another command is changing the keys; say it again") from None
        except FileNotFoundError:
            raise SettingsError(f"{folder}: no keys are here; make some with `mapweave keys init`") from None
        except OSError as error:
            raise SettingsError(f"{folder}: {reason_of(error)}") from None
        yield


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
