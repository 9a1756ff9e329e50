"""The folder that results go to: whether it can be made is known before minutes are spent on them."""

from __future__ import annotations

import os
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError


def check_output(folder: Path) -> Path:
    """Return a folder that is there or can be made. Nothing is made yet.

    Raises:
        SettingsError: a file is in the way, or nothing may be written there.
    """
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not there.is_dir():
        raise SettingsError(f"{there}: is a file; give a folder, or a place where one can be made")
    if not os.access(there, os.W_OK | os.X_OK):
        raise SettingsError(f"{there}: nothing may be written there; choose another folder")
    return folder
