"""A robot's key file whose certificate has expired."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from mapweave.identities.authority import Authority
from mapweave.identities.key_file import read_key_file, write_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.wire.credentials import Role

EXPIRED = "the certificate of r0 expired on 2026-01-03 03:04 UTC"


def expired_key(folder: Path) -> Path:
    """Make the keys of a fleet in a folder, and return the file of r0, which was good for a day."""
    keys = KeyFolder.create(folder, "demo", Profile.PRODUCTION, ["127.0.0.1"], "s0")
    path = keys.add("r0", Role.ROBOT)
    good = read_key_file(path)
    authority = Authority(good.credentials.authority, (folder / "authority.key").read_text())
    old = authority.issue("r0", Role.ROBOT, timedelta(days=1), now=datetime(2026, 1, 2, 3, 4, tzinfo=UTC))
    expired = replace(good.credentials, certificate=old.certificate, private_key=old.private_key)
    write_key_file(path, replace(good, credentials=expired))
    return path
