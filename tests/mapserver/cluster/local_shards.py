"""Shards in this process, asked by the same bytes as those of a cluster, that can be killed or held up."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

from mapweave.mapserver.cluster.gateway import ClusterGone
from mapweave.mapserver.cluster.shard import ShardServer
from mapweave.mapserver.cluster.shard_link import ShardLink
from mapweave.mapserver.cluster.sharded_index import ShardedIndex


class LocalShards:
    """Each shard works through its requests in order, in a thread of its own, as an actor does.

    Attributes:
        index: asks them.
        drop: says of a request whether it is lost on the way.
    """

    def __init__(self, shards: int, timeout: float = 10.0, stand_in_after: float = 60.0) -> None:
        self.servers: list[ShardServer | None] = [ShardServer() for _ in range(shards)]
        self.gates = [threading.Event() for _ in range(shards)]
        self.threads = [ThreadPoolExecutor(1) for _ in range(shards)]
        self.drop: Callable[[int, bytes], bool] = lambda shard, request: False
        self.gone = False
        for gate in self.gates:
            gate.set()
        self.links = [
            ShardLink(str(k), partial(self.call, k), timeout, stand_in_after) for k in range(shards)
        ]
        self.index = ShardedIndex(self.links)

    def call(self, shard: int, request: bytes) -> Future[bytes]:
        lost: Future[bytes] = Future()
        if self.gone:
            lost.set_exception(ClusterGone("the cluster is not there"))
            return lost
        if self.drop(shard, request):
            lost.set_exception(ConnectionError("lost on the way"))
            return lost
        return self.threads[shard].submit(self._answer, shard, request)

    def _answer(self, shard: int, request: bytes) -> bytes:
        assert self.gates[shard].wait(60.0)
        server = self.servers[shard]
        if server is None:
            raise ConnectionError("the actor is dead")
        return server.call(request)

    def kill(self, shard: int) -> None:
        """As kill -9: what it has is gone."""
        self.servers[shard] = None

    def restart(self, shard: int) -> None:
        """As Ray does: the constructor runs again."""
        self.servers[shard] = ShardServer()

    def close(self) -> None:
        for gate in self.gates:
            gate.set()
        self.index.close()
        for thread in self.threads:
            thread.shutdown()
