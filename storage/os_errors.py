"""What the operating system refuses, in words that say what to do."""

import errno
import os
import pwd

from mapweave.hybridmap.errors import InvalidFile

NO_ROOM = "the disk is full; make room, or give a place on another disk"
DISK_FULL = "the disk is full; make room, and what waits is written"
READ_ONLY = "the disk is read-only; a damaged disk becomes so by itself: see the system's log"


def reason_of(error: OSError) -> str:
    """Why a file or folder cannot be used, and what to do; in one line, without its name."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return no_permission()
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return NO_ROOM
    return READ_ONLY if error.errno == errno.EROFS else error.strerror or str(error)


def unreadable(path: str | os.PathLike[str], error: OSError) -> InvalidFile:
    """The error that a file cannot be read, and why."""
    return InvalidFile(f"{path}: cannot be read ({reason_of(error)})")


def no_permission() -> str:
    """That the user of this process may not do something with a file or folder."""
    return (
        f"permission denied to user {_user()}; give a place of your own, or change the owner or mode of "
        "this one (chown, chmod)"
    )


def _user() -> str:
    """The name of the user whose rights this process has; a container may have none."""
    number = os.geteuid()
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)
