"""Small disks that only one process and its children see, to be filled: file systems in memory."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest


def own_mounts(*, as_user: bool = True) -> list[str]:
    """The command before one that mounts disks of its own; skips the test where that cannot be.

    Args:
        as_user: in a namespace of one user, also for root; else root stays what it is.
    """
    user = ["--user", "--map-root-user"] if as_user or os.geteuid() else []
    unshare = ["unshare", *user, "--mount"]
    if not shutil.which("unshare") or subprocess.run([*unshare, "true"], capture_output=True).returncode:
        pytest.skip(f"needs mounts of its own ({' '.join(unshare)})")
    return unshare


def mount(folder: Path, size: str) -> Path:
    """A small disk, at a folder that is made."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", str(folder)], check=True)
    return folder


def make_read_only(folder: Path) -> None:
    """Have a disk take nothing any more."""
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)


def fill(folder: Path) -> None:
    """Leave no room."""
    with (folder / "ballast").open("wb", buffering=0) as ballast:
        try:
            while True:
                ballast.write(bytes(4096))
        except OSError:
            pass


def empty(folder: Path) -> None:
    """Make room again."""
    (folder / "ballast").unlink()
