"""The folder that results go to: whether it can be made is known before minutes are spent on them."""

import os
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError


def check_output(folder: Path) -> Path:
    """Return a folder that is there or can be made. Nothing is made yet.

    Raises:
        SettingsError: a file is in the way, or nothing may be written there.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise SettingsError(f"{existing}: is a file; give a folder, or a place where one can be made")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise SettingsError(f"{existing}: nothing may be written there; choose another folder")
    return folder
