"""What merging takes from beside the logs: others' merges, how the process before ended, and a secret."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mapweave.mapserver.log.store import CHOICE_KEY, Store
from mapweave.mapserver.merging.merge_retry import MergeRetry
from mapweave.mapserver.merging.stored_merges import StoredMerges


@dataclass(frozen=True, eq=False)
class MergeSurroundings:
    """What a server's merges depend on besides what robots and people send.

    Attributes:
        stored: hands merges over to other servers, or from them; None: this one merges for itself.
        retry: says when merging is tried again for which there was too little memory.
        choice_key: decides which pairs of views are held against their map's way.
    """

    stored: StoredMerges | None
    retry: MergeRetry
    choice_key: bytes

    @staticmethod
    def live(store: Store, name: str, path: Path, clock: Callable[[], float]) -> MergeSurroundings:
        """Of a server that robots get.

        Args:
            store: where the logs are.
            name: of the server.
            path: beside which it is kept that something is merged.
            clock: only grows, s.
        """
        stored = StoredMerges(store, name) if store.shared else None
        return MergeSurroundings(stored, MergeRetry(path, clock), store.secret(CHOICE_KEY))

    @staticmethod
    def repeatable(store: Store, name: str, path: Path, clock: Callable[[], float]) -> MergeSurroundings:
        """Of a server that does the same in each run: no other process and no chance has a part in it."""
        return MergeSurroundings(None, MergeRetry(None, clock), b"")


Surround = Callable[[Store, str, Path, Callable[[], float]], MergeSurroundings]
"""`MergeSurroundings.live`, or `MergeSurroundings.repeatable`."""
