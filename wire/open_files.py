"""How many files a router may have open: each of its sessions is one."""

import logging

try:
    import resource
except ImportError:  # of Unix alone
    resource = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

WANTED = 2**16
"""Files of a router with as many robots as it takes, and of all else."""


def allow_many_files() -> None:
    """Raise the soft limit of this process as far as the hard one lets it.

    Most systems begin with 1024 for the sake of select(), which nothing of a router uses.
    """
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = WANTED if hard == resource.RLIM_INFINITY else min(WANTED, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        except (OSError, ValueError) as error:
            log.warning("at most %d connections: the limit of open files cannot be raised (%s)", soft, error)
