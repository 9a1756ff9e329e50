"""Who corrects and annotates, for records."""

from __future__ import annotations

import getpass


def login() -> str:
    """Name of the person, for records."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no user of that number
        return "a person"
