"""Ranking: from the nearest landmarks of a view's features to nodes, best first, of one index or several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.retrieval import voting

REACH = 0.6
"""Distance of two decoded descriptors at which a vote counts nothing."""


class IncompleteSearch(MapweaveError):
    """A part of the map could not be searched, and the question needs all of it."""


class Ranked(list[tuple[NodeId, float]]):
    """Nodes with their similarity to a view, best first.

    Attributes:
        missing: in words, what of the map could not be searched; empty if all of it was.
    """

    def __init__(self, nodes: Iterable[tuple[NodeId, float]] = (), missing: str = "") -> None:
        super().__init__(nodes)
        self.missing = missing


@dataclass(frozen=True, eq=False)
class NearestLandmarks:
    """The nearest landmarks of each of N features.

    Attributes:
        squared: (N, k) squared distances, nearest first.
        owners: (N, k) which of `nodes` has the landmark; -1 for none.
        nodes: that have any of them.
    """

    squared: NDArray[np.float32]
    owners: NDArray[np.int64]
    nodes: tuple[NodeId, ...]

    @staticmethod
    def none(features: int, k: int) -> NearestLandmarks:
        """The ranking of so many features, where there are no landmarks."""
        nowhere = np.full((features, k), -1)
        return NearestLandmarks(np.full((features, k), np.inf, np.float32), nowhere, ())

    @staticmethod
    def together(parts: Sequence[NearestLandmarks], k: int) -> NearestLandmarks:
        """The k nearest of all parts: what one index of all their nodes gives.

        Args:
            parts: of the same features, at least one.
            k: landmarks wanted for a feature.
        """
        starts = np.cumsum([0, *(len(part.nodes) for part in parts)])
        squared = np.concatenate([part.squared for part in parts], axis=1)
        owners = np.concatenate(
            [
                np.where(part.owners < 0, -1, part.owners + start)
                for part, start in zip(parts, starts, strict=False)
            ],
            axis=1,
        )
        # What is no landmark is last.
        order = np.argsort(np.where(owners < 0, np.inf, squared), axis=1, kind="stable")[:, :k]
        return NearestLandmarks(
            np.take_along_axis(squared, order, axis=1),
            np.take_along_axis(owners, order, axis=1),
            tuple(node for part in parts for node in part.nodes),
        )

    def ranked(self, k: int) -> list[tuple[NodeId, float]]:
        """At most k nodes by their votes, see `rank`."""
        return rank(self.squared, self.owners, dict(enumerate(self.nodes)), k)


def rank(
    squared: NDArray[np.float32],
    owners: NDArray[np.int64],
    names: Mapping[int, NodeId],
    k: int,
) -> list[tuple[NodeId, float]]:
    """Rank nodes by the votes of features, see mapweave.mapserver.retrieval.voting.votes.

    Args:
        squared: (N, k) squared distances of N features' nearest landmarks, nearest first.
        owners: (N, k) the nodes of the landmarks, by number; below 0 for none.
        names: of the nodes.
        k: nodes wanted at most.

    Returns:
        Nodes with a positive score, best first.
    """
    voted, scores = voting.votes(squared, owners, REACH)
    if not len(scores):
        return []
    best = np.flatnonzero(scores >= np.sort(scores)[-min(k, len(scores))])
    ranked = [(names[int(voted[i])], float(scores[i])) for i in best]
    return sorted(ranked, key=lambda item: (-item[1], item[0]))[:k]
