"""The ceiling: every real place compared with every view, by whole descriptors, and judged as always.

Distractors are not compared: they are never the right answer, so without them the ceiling is, if anything,
too high.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.relocalize_places import Place
from benchmarks.relocalize_queries import Query
from hybridmap.descriptor import root_sift
from hybridmap.matching import match_vectors, squared_distances
from hybridmap.query import RelocalizeAnswer
from hybridmap.recognition import Recognition, RecognitionSettings, examine_matches
from mapserver.relocalization import RelocalizationSettings, Relocalizer
from mapserver.seenplaces import Sighting, is_lonely

RIVALS = RelocalizationSettings().candidates
"""Places that look most like a view, among which doubles are looked for."""
BLOCK = 4096
"""Landmarks that are compared at once."""


class Exhaustive:
    """Compares with every place."""

    def __init__(self, places: Sequence[Place], relocalizer: Relocalizer) -> None:
        """Take the places, and who judges."""
        self._places = places
        self._roots = [root_sift(place.sift) for place in places]
        self._all = np.concatenate(self._roots)
        self._ends = np.cumsum([len(one) for one in self._roots])
        self._relocalizer = relocalizer
        self._settings = RecognitionSettings()

    def answer(self, query: Query) -> RelocalizeAnswer:
        """As a relocalizer answers."""
        roots, view = root_sift(query.picture.sift), query.picture.view
        sightings, counts = [], self._may_match(roots)
        for k in np.flatnonzero(counts >= self._settings.least_inliers).tolist():
            place = self._places[k]
            pairs = match_vectors(self._roots[k], roots, self._settings.matching).pairs
            if len(pairs) < self._settings.least_inliers:
                continue
            rng = np.random.default_rng(zlib.crc32(str(place.node.id).encode()))
            verdict = examine_matches(place.node, view, pairs, self._settings, rng)
            if isinstance(verdict, Recognition):
                lonely = is_lonely(place.node, view.camera, verdict)
                sightings.append(Sighting(place.node.id, verdict, lonely=lonely))
        most = np.argsort(-counts, kind="stable")[:RIVALS].tolist()
        return self._relocalizer.conclude(
            view, sightings, [(self._places[k].node.id, float(counts[k])) for k in most]
        )

    def _may_match(self, roots: NDArray[np.float32]) -> NDArray[np.int64]:
        """(P,) landmarks of each place that pass the matching's own test on their side: no fewer than match.

        The match of a landmark must be near, and nearer than any other feature of the view by the ratio,
        whatever else its node sees.
        """
        s, passed = self._settings.matching, np.zeros(len(self._all), np.bool_)
        if len(roots) < 2:
            return np.diff(self._ends, prepend=0)
        for start in range(0, len(self._all), BLOCK):
            squared = squared_distances(self._all[start : start + BLOCK], roots)
            rows, best = np.arange(len(squared)), squared.argmin(axis=1)
            first = squared[rows, best]
            squared[rows, best] = np.inf
            passed[start : start + BLOCK] = (first <= s.most_distance**2 + 1e-4) & (
                first <= s.ratio**2 * squared.min(axis=1) + 1e-4
            )
        counts: NDArray[np.int64] = np.diff(np.concatenate([[0], np.cumsum(passed)])[self._ends], prepend=0)
        return counts
