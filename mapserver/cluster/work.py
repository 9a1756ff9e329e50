"""Work for any process of the cluster: pure functions of what is sent.

Whatever does not come back is done here, so a process that fails does no harm.
"""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from itertools import islice

from mapweave.mapserver.cluster.messages import (
    Comparison,
    ComparisonAnswer,
    Pairs,
    decoded,
    encoded,
)
from mapweave.mapserver.merging.node_comparisons import compare
from mapweave.merge.pose_graph.verdicts import Verdict

log = logging.getLogger(__name__)

Call = Callable[[bytes], "Future[bytes]"]
PAIRS = 4
"""In one request: about 10 ms of work, beside 3 ms for sending it."""
AHEAD = 4
"""Requests for each worker that are on their way at once."""
PATIENCE, TRUCE = 5.0, 30.0
"""s for an answer, and s without asking after one that has not come: others may use the cluster, too."""


def answer_work(request: bytes) -> bytes:
    """Compare the nodes of a Comparison.

    Raises:
        InvalidMessage: the request is none.
    """
    comparison: Comparison = decoded(request, Comparison)
    return encoded(ComparisonAnswer.of(compare(comparison.node_pairs())))


class WorkPool:
    """Hands work to the cluster."""

    def __init__(self, call: Call, workers: Callable[[], int]) -> None:
        """Take the way to the workers, and how many there are: 0 while there is no cluster."""
        self._call, self._workers = call, workers
        self._not_before = 0.0

    @property
    def _silent(self) -> bool:
        """Whether workers have not answered of late."""
        return time.monotonic() < self._not_before

    def compare(self, pairs: Pairs) -> Iterable[Verdict]:
        """Compare pairs of nodes; see `mapweave.mapserver.merging.node_comparisons.compare`."""
        if len(pairs) <= PAIRS:  # a single worker would be no faster
            return compare(pairs)
        return (verdict for verdicts in self._compared(pairs) for verdict in verdicts)

    def _compared(self, pairs: Pairs) -> Iterator[Iterable[Verdict]]:
        """The verdicts on some pairs after the others, in order."""
        rest = iter(pairs)
        parts = iter(lambda: list(islice(rest, PAIRS)), [])
        asked: list[tuple[Pairs, Future[bytes] | None]] = []
        part: Pairs
        while True:
            workers = 0 if self._silent else self._workers()
            for part in islice(parts, max(max(AHEAD * workers, 1) - len(asked), 0)):
                sent = self._call(encoded(Comparison.of(part))) if workers else None
                asked.append((part, sent))
            if not asked:
                return
            part, sent = asked.pop(0)
            yield self._verdicts(part, sent)

    def _verdicts(self, pairs: Pairs, sent: Future[bytes] | None) -> Iterable[Verdict]:
        if sent is not None:
            try:
                data = sent.result(0.0 if self._silent else PATIENCE)
                answer: ComparisonAnswer = decoded(data, ComparisonAnswer)
                return answer.verdicts_on(pairs)
            except TimeoutError:
                if not self._silent:
                    self._not_before = time.monotonic() + TRUCE
                    log.warning("no worker of the cluster answers in %g s: nodes are compared here", PATIENCE)
            except Exception as error:  # noqa: BLE001 - whatever it is, it is done here
                log.debug("no answer from the cluster: %s", error)
        return compare(pairs)
