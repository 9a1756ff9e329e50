"""Work for any process of the cluster: pure functions of what is sent.

Whatever does not come back is done here, so a process that fails does no harm.
"""

from __future__ import annotations

import logging
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from itertools import islice
from typing import Any

from mapweave.hybridmap.node import Node
from mapweave.mapserver.merging.node_comparisons import compare
from mapweave.mapserver.retrieval.compared_landmarks import bounded
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
    """Do what a request asks for."""
    name, argument = pickle.loads(request)
    return pickle.dumps(FUNCTIONS[name](argument))


FUNCTIONS: dict[str, Callable[[Any], Any]] = {"compare": lambda pairs: [*compare(pairs)]}


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

    def compare(self, pairs: Sequence[tuple[Node, Node]]) -> Iterable[Verdict]:
        """Compare pairs of nodes; see `mapweave.mapserver.merging.node_comparisons.compare`."""
        if len(pairs) <= PAIRS:  # a single worker would be no faster
            return compare(pairs)
        rest = iter([(bounded(a), bounded(b)) for a, b in pairs])
        parts = iter(lambda: list(islice(rest, PAIRS)), [])
        return (verdict for verdicts in self._map("compare", parts) for verdict in verdicts)

    def _map(self, name: str, arguments: Iterator[Any]) -> Iterator[Any]:
        """The results, in order."""
        asked: list[tuple[Any, Future[bytes] | None]] = []
        while True:
            workers = 0 if self._silent else self._workers()
            for argument in islice(arguments, max(max(AHEAD * workers, 1) - len(asked), 0)):
                sent = self._call(pickle.dumps((name, argument))) if workers else None
                asked.append((argument, sent))
            if not asked:
                return
            argument, sent = asked.pop(0)
            yield self._result(name, argument, sent)

    def _result(self, name: str, argument: Any, sent: Future[bytes] | None) -> Any:
        if sent is not None:
            try:
                return pickle.loads(sent.result(0.0 if self._silent else PATIENCE))
            except TimeoutError:
                if not self._silent:
                    self._not_before = time.monotonic() + TRUCE
                    log.warning("no worker of the cluster answers in %g s: nodes are compared here", PATIENCE)
            except Exception as error:  # noqa: BLE001 - whatever it is, it is done here
                log.debug("no answer from the cluster: %s", error)
        return FUNCTIONS[name](argument)
