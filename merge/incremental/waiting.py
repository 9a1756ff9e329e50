"""Links of a large merge that wait, in columns: where they lie as components grow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from merge.graph.candidates import Pair
from merge.graph.links import Link
from merge.incremental.factors import Rows
from merge.incremental.sheets import Assembly, MapPair

Labels = tuple[int, int]
"""Of two components, smaller first."""


class Waiting:
    """All links that wait when a step begins to join. Rows of nodes stay what they are in one step.

    Attributes:
        links: N.
        weights: (N,) see `Link.weight`.
    """

    def __init__(self, waiting: Mapping[MapPair, Mapping[Pair, Link]], whole: Assembly) -> None:
        """Take them from the ledger.

        Args:
            waiting: by maps.
            whole: the graph as it is.
        """
        self._maps = sorted(waiting)
        self.links = [link for maps in self._maps for link in waiting[maps].values()]
        self.weights = np.array([link.weight for link in self.links], np.int64)
        self._rows = whole.rows(link.a for link in self.links), whole.rows(link.b for link in self.links)
        counts = [len(waiting[maps]) for maps in self._maps]
        self._seats = np.repeat(np.arange(len(self._maps)), counts)
        self._seat_of = {maps: k for k, maps in enumerate(self._maps)}
        self._number = {link.pair: k for k, link in enumerate(self.links)}
        self._waits = np.ones(len(self.links), np.bool_)

    def accept(self, links: Iterable[Link]) -> None:
        """These wait no longer."""
        self._waits[[self._number[link.pair] for link in links]] = False

    def inside(self, between: Iterable[MapPair], whole: Assembly) -> dict[int, list[Link]]:
        """Those between some maps that lie within a component, by its label."""
        first, second = self._labels(whole)
        here = np.flatnonzero(self._among(between) & (first == second))
        return {label: [self.links[k] for k in some.tolist()] for label, some in _split(first[here], here)}

    def pools(self, between: Iterable[MapPair], whole: Assembly) -> dict[Labels, Rows]:
        """All that lie between two components, if any of them lies between some maps: which they are."""
        first, second = self._labels(whole)
        low, high = np.minimum(first, second), np.maximum(first, second)
        count = len(whole.labels)
        keys = low * count + high
        wanted = np.unique(keys[self._among(between) & (low != high)])
        here = np.flatnonzero(self._waits & (low != high) & np.isin(keys, wanted))
        return {(key // count, key % count): some for key, some in _split(keys[here], here)}

    def apart(self, whole: Assembly) -> set[MapPair]:
        """Maps between which any of them lies between two components."""
        first, second = self._labels(whole)
        return {self._maps[k] for k in np.unique(self._seats[self._waits & (first != second)]).tolist()}

    def _labels(self, whole: Assembly) -> tuple[Rows, Rows]:
        return whole.labels[self._rows[0]], whole.labels[self._rows[1]]

    def _among(self, between: Iterable[MapPair]) -> NDArray[np.bool_]:
        some = np.zeros(len(self._maps), np.bool_)
        some[[self._seat_of[maps] for maps in between if maps in self._seat_of]] = True
        out: NDArray[np.bool_] = self._waits & some[self._seats]
        return out


def _split(keys: Rows, values: Rows) -> list[tuple[int, Rows]]:
    """Values by their keys, in the order of the keys."""
    order = np.argsort(keys, kind="stable")
    known, starts = np.unique(keys[order], return_index=True)
    return list(zip(known.tolist(), np.split(values[order], starts[1:]), strict=True)) if len(keys) else []
