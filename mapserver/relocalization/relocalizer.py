"""Relocalization of lost robots: retrieve candidates, register the view with them, decide between places.

An answer is FOUND only if every place that explains the view about as well is the same place. Whether two
places are the same is asked of the merged map: the poses that they give must agree within what the map and
the recognitions are certain of.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.mapserver.relocalization.alias_cache import AliasCache
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegions, AliasedRegionSettings
from mapweave.mapserver.relocalization.candidates import Retrieval, retrieve
from mapweave.mapserver.relocalization.relocalize_answer import answer_of
from mapweave.mapserver.relocalization.verdict import HypothesisSelector
from mapweave.mapserver.relocalization.view_registration import Registration, ViewRegistration
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.recognition import RecognitionSettings


@dataclass(frozen=True)
class RelocalizationSettings:
    """How a view is answered.

    Attributes:
        recognition: when a view counts as recognised.
        regions: when a place counts as being there twice, by its surroundings.
        faint: candidates with less than this share of a recognised node's similarity are not registered.
    """

    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)
    regions: AliasedRegionSettings = field(default_factory=AliasedRegionSettings)
    faint: float = 0.25


class Relocalizer:
    """Answers where views were taken. It belongs to one merged map; make another for the next.

    Attributes:
        registration: compares views with nodes.
        aliasing: which regions look the same.
        selection: decides between places.
    """

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        settings: RelocalizationSettings | None = None,
        alike: AliasCache | None = None,
        first: Relocalizer | None = None,
    ) -> None:
        """Take what is known.

        Args:
            index: finds candidates of a view; may have nodes that are not in the merged map yet.
            node_of: gives a node by its id, for example `Merger.node`.
            merged: where nodes are.
            settings: how.
            alike: cache of aliased nodes; outlives the merged map.
            first: is asked before, and answers alone where it is certain: it knows less, and nothing of which
                the truth is in doubt.
        """
        s = settings or RelocalizationSettings()
        self._index, self._node_of, self._merged, self._first = index, node_of, merged, first
        self._least_features = least = s.recognition.least_inliers
        self.alike = alike or AliasCache(s.recognition)
        self.registration = ViewRegistration(node_of, merged, s.recognition, s.faint)
        self.aliasing = AliasedRegions(index, node_of, merged, self.alike, s.regions)
        self.selection = HypothesisSelector(merged, self.aliasing, least)

    def answer(self, view: View, elsewhere: Collection[MapId] = ()) -> RelocalizeAnswer:
        """Where a view was taken, or unknown, with the reason in words.

        Args:
            view: the image's features.
            elsewhere: maps on which the robot knows that it is not.
        """
        if self._first is not None:
            answer = self._first.answer(view, elsewhere)
            if answer.certainty in (Certainty.FOUND, Certainty.PLACE):
                return answer
        candidates = retrieve(view, self._index, self._least_features, elsewhere)
        registration = self.registration.register(candidates)
        return self.conclude(registration)

    def conclude(self, registration: Registration) -> RelocalizeAnswer:
        """The answer that follows from the recognised nodes."""
        verdict = self.selection.decide(registration)
        return answer_of(verdict, self._merged, self._node_of, self._least_features)

    def prepare(self, most: int) -> int:
        """Evaluate the aliases of at most so many nodes in advance, and return how many are left."""
        return self.aliasing.prepare(most)
