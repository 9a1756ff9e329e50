"""Retrieval: candidate nodes for a view. The first of three steps to an answer."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.query import View
from mapweave.mapserver.retrieval.ranking import Ranked

MOST_COMPARED = 16
"""Nodes that are compared with the view."""
ALIKE_FLOORS = 16
"""Of a robot that knows its floor so many times as many are retrieved: so many floors may look alike."""


class Retrieval(Protocol):
    """Finds candidate nodes for a view, for example mapweave.mapserver.retrieval.place_index.PlaceIndex."""

    def query(self, view: View, k: int = 5) -> Ranked:
        """At most k nodes with their similarity to it, best first."""


@dataclass(frozen=True, eq=False)
class RetrievedNodes:
    """The nodes that retrieval found for a view.

    Attributes:
        view: the image's features.
        ranked: nodes with their similarity to it, best first.
        elsewhere: maps on which the robot knows that it is not.
        missing: in words, what of the map could not be searched; empty if all of it was.
    """

    view: View
    ranked: Sequence[tuple[NodeId, float]] = ()
    elsewhere: Collection[MapId] = ()
    missing: str = ""


def retrieve(
    view: View, index: Retrieval, least_features: int, elsewhere: Collection[MapId] = ()
) -> RetrievedNodes:
    """Find candidates; none for a view with fewer features than registration needs."""
    if len(view) < least_features:
        return RetrievedNodes(view)
    ranked = index.query(view, MOST_COMPARED * (ALIKE_FLOORS if elsewhere else 1))
    left = [(node, score) for node, score in ranked if node.map not in elsewhere]
    return RetrievedNodes(view, left[:MOST_COMPARED], elsewhere, ranked.missing)
