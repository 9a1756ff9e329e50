"""The cluster as the server uses it: an index in shards, and nodes compared by its workers."""

from __future__ import annotations

from functools import partial

from mapweave.mapserver.cluster.gateway import WORK, Gateway
from mapweave.mapserver.cluster.settings import ClusterSettings
from mapweave.mapserver.cluster.shard_link import ShardLink
from mapweave.mapserver.cluster.sharded_index import ShardedIndex
from mapweave.mapserver.cluster.work import WorkPool


class Cluster:
    """Works with the cluster while it is there, and without it while it is not.

    Attributes:
        index: the place index.
        pool: does work anywhere in the cluster.
    """

    def __init__(self, settings: ClusterSettings) -> None:
        """Prepare; nothing runs yet."""
        s = settings
        self._gateway = Gateway(s.ray, s.shards)
        self.index = ShardedIndex(
            [ShardLink(str(k), partial(self._gateway.ask, k), s.timeout) for k in range(s.shards)]
        )
        self.pool = WorkPool(partial(self._gateway.ask, WORK), lambda: self._gateway.workers)
        self.compare = self.pool.compare

    def start(self) -> None:
        """Begin to reach the cluster."""
        self._gateway.start()
        self.index.start()

    def close(self) -> None:
        """Leave the cluster. Idempotent."""
        self.index.close()
        self._gateway.close()
