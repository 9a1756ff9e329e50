"""Tells a lost robot where it is: retrieve candidates, register the view with them, decide between places.

An answer is FOUND only if every place that explains the view about as well is the same place. Whether two
places are the same is asked of the merged map: the poses that they give must agree within what the map and
the recognitions are certain of.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.query import RelocalizeAnswer, View
from mapweave.mapserver.relocalization.alias_cache import AliasCache
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegionSettings
from mapweave.mapserver.relocalization.candidates import Retrieval, retrieve
from mapweave.mapserver.relocalization.perceptual_aliasing import PerceptualAliasing
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
        faint: a node that looks so much less like the view than one that was recognised is not looked at.
    """

    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)
    regions: AliasedRegionSettings = field(default_factory=AliasedRegionSettings)
    faint: float = 0.25


class Relocalizer:
    """Answers where views were taken. It stands for one merged map; make another for the next.

    Attributes:
        registration: compares views with nodes.
        aliasing: which places look alike.
        selection: decides between places.
    """

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        settings: RelocalizationSettings | None = None,
        alike: AliasCache | None = None,
    ) -> None:
        """Take what is known.

        Args:
            index: which nodes look like a view; may know nodes that the merged map does not know yet.
            node_of: gives a node by its id, for example `Merger.node`.
            merged: where nodes are.
            settings: how.
            alike: which nodes look alike; outlives the merged map, so that it is found out once.
        """
        s = settings or RelocalizationSettings()
        self._index, self._node_of, self._merged = index, node_of, merged
        self._least_features = least = s.recognition.least_inliers
        self.alike = alike or AliasCache(s.recognition)
        self.registration = ViewRegistration(node_of, merged, s.recognition, s.faint)
        self.aliasing = PerceptualAliasing(
            index, node_of, merged, self.alike, s.recognition, s.regions, s.faint
        )
        self.selection = HypothesisSelector(merged, self.aliasing, least)

    def answer(self, view: View) -> RelocalizeAnswer:
        """Say where a view was taken, or that it is not known, with the reason in words."""
        candidates = retrieve(view, self._index, self._least_features)
        registration = self.registration.register(candidates)
        return self.conclude(registration)

    def conclude(self, registration: Registration) -> RelocalizeAnswer:
        """Say what follows from the nodes that were recognised."""
        verdict = self.selection.decide(registration)
        return answer_of(verdict, self._merged, self._node_of, self._least_features)

    def prepare(self, most: int) -> int:
        """Find out what at most so many nodes look like before anybody asks, and say how many are left."""
        return self.aliasing.prepare(most)
