"""The cluster as the server uses it: an index in shards, and nodes compared by its workers."""

from functools import partial

from mapweave.mapserver.cluster.gateway import WORK, Gateway
from mapweave.mapserver.cluster.settings import ClusterSettings
from mapweave.mapserver.cluster.shard_link import ShardLink
from mapweave.mapserver.cluster.sharded_index import ShardedIndex
from mapweave.mapserver.cluster.work import WorkPool
from mapweave.mapserver.merging.node_comparisons import Compare, compare


class Cluster:
    """Works with the cluster while it is there, and without it while it is not, or if there is to be none.

    Attributes:
        index: the place index; None without a cluster.
        compare: compares nodes.
    """

    def __init__(self, settings: ClusterSettings) -> None:
        """Prepare; nothing runs yet."""
        s = settings
        self.index: ShardedIndex | None = None
        self.compare: Compare = compare
        if s.ray:
            self._gateway = gateway = Gateway(s.ray, s.shards)
            self.index = ShardedIndex(
                [ShardLink(str(k), partial(gateway.ask, k), s.timeout) for k in range(s.shards)]
            )
            self.compare = WorkPool(partial(gateway.ask, WORK), lambda: gateway.workers).compare

    @property
    def status(self) -> str:
        """The state for people, for example `4 of 4 shards`; empty without a cluster."""
        return "" if self.index is None else self.index.status

    def start(self) -> None:
        """Begin to reach the cluster."""
        if self.index is not None:
            self._gateway.start()
            self.index.start()

    def close(self) -> None:
        """Leave the cluster. Idempotent."""
        if self.index is not None:
            self.index.close()
            self._gateway.close()
