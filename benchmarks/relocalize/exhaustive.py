"""The ceiling: every node compared with every view, by whole descriptors, and judged as always."""

import math
import zlib
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.relocalize.places import TruePlace
from benchmarks.relocalize.queries import Query
from benchmarks.relocalize.score import ScoredAnswer
from mapweave.hybridmap.descriptor import root_sift
from mapweave.hybridmap.query import RelocalizeAnswer
from mapweave.mapserver.relocalization.candidates import MOST_COMPARED, RetrievedNodes
from mapweave.mapserver.relocalization.place_hypotheses import NodeMatch, is_one_thing
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.relocalization.view_registration import Registration
from mapweave.registration.matching import match_vectors, squared_distances
from mapweave.registration.recognition import Recognition, RecognitionSettings, examine_matches

AT_MOST = 10_000
"""Nodes; of a larger fleet so many are compared, all that are real among them."""
COMPARISONS = 400_000
"""Of views with nodes, about: among many nodes not every view is asked."""
RIVALS = MOST_COMPARED
"""Places that look most like a view, among which aliases are looked for."""
NODES_AT_ONCE = 40
"""Whose landmarks are compared at once."""

PlaceOf = Callable[[int], TruePlace]
"""A place of the fleet by its number, those that are real first."""


def asked_of(queries: Sequence[Query], nodes: int) -> list[Query]:
    """Which views are asked among so many nodes: all, or every so manyth."""
    return list(queries[:: max(1, math.ceil(len(queries) * nodes / COMPARISONS))])


class Exhaustive:
    """Compares with every place."""

    def __init__(self, place_of: PlaceOf, count: int, relocalizer: Relocalizer) -> None:
        """Take the places, how many there are, and who judges."""
        self._place_of, self._count = place_of, count
        self._relocalizer = relocalizer
        self._settings = RecognitionSettings()

    def answers(self, queries: Sequence[Query], progress: Callable[[], None]) -> list[RelocalizeAnswer]:
        """Answers as a relocalizer gives them; progress is called once a node, then once a query."""
        roots = [root_sift(query.picture.sift) for query in queries]
        counts = self.may_match(roots, progress)
        answers = []
        for query, root, row in zip(queries, roots, counts, strict=True):
            answers.append(self._answer(query, root, row))
            progress()
        return answers

    def _answer(
        self, query: Query, roots: NDArray[np.float32], counts: NDArray[np.int64]
    ) -> RelocalizeAnswer:
        view, sightings = query.picture.view, []
        for k in np.flatnonzero(counts >= self._settings.least_inliers).tolist():
            place = self._place_of(k)
            pairs = match_vectors(root_sift(place.sift), roots, self._settings.matching)
            if len(pairs) < self._settings.least_inliers:
                continue
            rng = np.random.default_rng(zlib.crc32(str(place.node.id).encode()))
            verdict = examine_matches(place.node, view, pairs, self._settings, rng)
            if isinstance(verdict, Recognition):
                one_thing = is_one_thing(place.node, view, verdict)
                sightings.append(NodeMatch(place.node.id, verdict, one_thing=one_thing))
        most = np.argsort(-counts, kind="stable")[:RIVALS].tolist()
        ranked = [(self._place_of(k).node.id, float(counts[k])) for k in most]
        matches = self._relocalizer.registration.refined(view, sightings)
        return self._relocalizer.conclude(Registration(RetrievedNodes(view, ranked), matches))

    def may_match(
        self, views: Sequence[NDArray[np.float32]], progress: Callable[[], None] = lambda: None
    ) -> NDArray[np.int64]:
        """(Q, P) landmarks of each place that pass the matching's test on their side: no fewer than match.

        The match of a landmark must be near, and nearer than any other feature of the view by the ratio,
        whatever else its node sees.
        """
        s = self._settings.matching
        counts = np.zeros((len(views), self._count), np.int64)
        for start in range(0, self._count, NODES_AT_ONCE):
            some = range(start, min(start + NODES_AT_ONCE, self._count))
            block = [root_sift(self._place_of(k).sift) for k in some]
            together, ends = np.concatenate(block), np.cumsum([len(one) for one in block])
            rows = np.arange(len(together))
            for q, view in enumerate(views):
                if len(view) < 2:
                    counts[q, some] = [len(one) for one in block]
                    continue
                squared = squared_distances(together, view)
                best = squared.argmin(axis=1)
                first = squared[rows, best]
                squared[rows, best] = np.inf
                passed = (first <= s.most_distance**2 + 1e-4) & (
                    first <= s.ratio**2 * squared.min(axis=1) + 1e-4
                )
                counts[q, some] = np.diff(np.concatenate([[0], np.cumsum(passed)])[ends], prepend=0)
            for _ in some:
                progress()
        return counts


def lost(ours: Sequence[ScoredAnswer], theirs: Sequence[ScoredAnswer]) -> dict[str, float]:
    """How much less is recalled than by the exhaustive search, of the same views, with 95 % of certainty.

    The interval is that of Bonett and Price (2012) for the difference of paired proportions.
    """
    n = len(ours)
    only_theirs = sum(b.recalled and not a.recalled for a, b in zip(ours, theirs, strict=True))
    only_ours = sum(a.recalled and not b.recalled for a, b in zip(ours, theirs, strict=True))
    p, q = (only_theirs + 1) / (n + 2), (only_ours + 1) / (n + 2)
    spread = 1.96 * math.sqrt((p + q - (p - q) ** 2) / (n + 2))
    return {
        "exhaustive_queries": n, "only_exhaustive": only_theirs, "only_index": only_ours,
        "recall_lost": round((only_theirs - only_ours) / n, 4),
        "recall_lost_low": round(p - q - spread, 4), "recall_lost_high": round(p - q + spread, 4),
    }  # fmt: skip
