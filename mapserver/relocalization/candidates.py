"""Retrieval: which nodes look like a view. The first of three steps to an answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.query import View

MOST_COMPARED = 16
"""Nodes that are compared with the view."""


class Retrieval(Protocol):
    """Finds nodes that look like a view, for example mapweave.mapserver.retrieval.place_index.PlaceIndex."""

    def query(self, view: View, k: int = 5) -> list[tuple[NodeId, float]]:
        """At most k nodes with how much they look like it, best first."""
        ...


@dataclass(frozen=True, eq=False)
class Candidates:
    """Nodes that look like a view.

    Attributes:
        view: the image's features.
        ranked: nodes with how much they look like it, best first.
    """

    view: View
    ranked: Sequence[tuple[NodeId, float]] = ()


def retrieve(view: View, index: Retrieval, least_features: int) -> Candidates:
    """Find candidates; none for a view with fewer features than registration needs."""
    if len(view) < least_features:
        return Candidates(view)
    return Candidates(view, index.query(view, MOST_COMPARED))
