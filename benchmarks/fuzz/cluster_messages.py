"""What passes between a server, its gateway, shards and workers: each message is taken or refused."""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path

from mapweave.hybridmap.node import Node
from mapweave.mapserver.cluster.frames import GatewayReply, GatewayRequest
from mapweave.mapserver.cluster.messages import (
    Ask,
    ComparedNodes,
    Comparison,
    ComparisonAnswer,
    Hello,
    Ids,
    Nearest,
    Overlaps,
    Question,
    ShardChange,
    ShardRequest,
    State,
    answer_message,
    answer_to,
    decoded,
    encoded,
)
from mapweave.mapserver.cluster.shard import Shard, ShardServer
from mapweave.mapserver.cluster.work import answer_work
from mapweave.mapserver.merging.node_comparisons import compare


class ClusterMessages:
    """A shard with some nodes, and a good message of each kind."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        """Fill the shard."""
        shard = Shard()
        shard.change(nodes)
        pairs = [*pairwise(nodes)]
        nearest, overlaps = Nearest(nodes[0].landmarks.codes, 16, 1000), Overlaps(ComparedNodes.of(nodes[:1]))
        server = ShardServer()
        state: State = decoded(server.call(encoded(Hello())), State)
        change = ShardChange(state, ComparedNodes.of(nodes[:2]), Ids.of([nodes[2].id]))
        readers: list[tuple[Callable[[bytes], object], list[bytes]]] = [
            (server.call, [encoded(Ask(state, encoded(nearest)))]),
            (lambda data: _nodes(decoded(data, ShardRequest)), [encoded(change)]),
            (answer_work, [encoded(Comparison.of(pairs[:1]))]),
            (lambda data: shard.answer(decoded(data, Question)), [encoded(nearest), encoded(overlaps)]),
            (lambda data: answer_to(nearest, data), [encoded(answer_message(shard.answer(nearest)))]),
            (lambda data: answer_to(overlaps, data), [encoded(answer_message(shard.answer(overlaps)))]),
            (lambda data: decoded(data, ComparisonAnswer).verdicts_on(pairs),
             [encoded(ComparisonAnswer.of(compare(pairs)))]),
            (lambda data: decoded(data, State), [encoded(state)]),
            (GatewayRequest.read, [GatewayRequest(7, 2, b"abc").packed()]),
            (GatewayReply.read, [GatewayReply(7, words="it failed").packed()]),
        ]  # fmt: skip
        self._read = [read for read, _ in readers]
        self.samples = [bytes([k]) + one for k, (_, some) in enumerate(readers) for one in some]

    def run(self, data: bytes) -> None:
        """The first byte chooses the reader."""
        if data:
            self._read[data[0] % len(self._read)](data[1:])


def _nodes(request: ShardRequest) -> list[Node]:
    return request.nodes.nodes if isinstance(request, ShardChange) else []


@cache
def cluster_messages() -> ClusterMessages:
    """Messages about a room that was mapped twice."""
    # Not before it is needed: it makes more than this.
    from benchmarks.fuzz.samples import Samples

    return ClusterMessages(Samples(1).nodes)


def run(data: bytes, _: Path) -> None:
    """Read a message."""
    cluster_messages().run(data)
