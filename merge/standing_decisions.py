"""What a merge has decided, from which the next one of the same maps begins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from mapweave.hybridmap.ids import NodeId
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.solved_graph import PoseGraph


@dataclass(frozen=True, eq=False)
class StandingDecisions:
    """Standing decisions on links, by their pairs: what was decided of each, and where that put the nodes.

    A decision holds for the very link that it was made of, compared by identity: links are never changed,
    only replaced.

    Attributes:
        given: the links as they were verified.
        weighed: the same with the landmarks that are known to be found elsewhere too.
        believed: which of them join maps.
        refused: the others, with reasons.
        refuted: those of them that mutual exclusion refutes.
        graphs: the components.
        fragments: the pieces of map that these are made of.
        contradicted: links by hand that mutual exclusion contradicts, and how.
        size: links that there were when all were decided together.
        changed: links that have come or gone since.
    """

    given: Mapping[Pair, Link] = field(default_factory=dict)
    weighed: Mapping[Pair, Link] = field(default_factory=dict)
    believed: frozenset[Pair] = frozenset()
    refused: Mapping[Pair, RefusedLink] = field(default_factory=dict)
    refuted: frozenset[Pair] = frozenset()
    graphs: tuple[PoseGraph, ...] = ()
    fragments: tuple[Fragment, ...] = ()
    contradicted: Mapping[Pair, str] = field(default_factory=dict)
    size: int = 0
    changed: int = 0

    @cached_property
    def _component(self) -> dict[NodeId, int]:
        return {node: k for k, graph in enumerate(self.graphs) for node in graph.nodes}

    def together(self, a: NodeId, b: NodeId) -> bool:
        """Whether two nodes are in one component."""
        return self._component.get(a) == self._component.get(b)

    @staticmethod
    def union(parts: Iterable[StandingDecisions]) -> StandingDecisions:
        """The union of decisions on maps that nothing tied together before."""
        some = list(parts)
        return StandingDecisions(
            {pair: link for decisions in some for pair, link in decisions.given.items()},
            {pair: link for decisions in some for pair, link in decisions.weighed.items()},
            frozenset().union(*(decisions.believed for decisions in some)),
            {pair: refusal for decisions in some for pair, refusal in decisions.refused.items()},
            frozenset().union(*(decisions.refuted for decisions in some)),
            tuple(graph for decisions in some for graph in decisions.graphs),
            tuple(fragment for decisions in some for fragment in decisions.fragments),
            {pair: words for decisions in some for pair, words in decisions.contradicted.items()},
            sum(decisions.size for decisions in some),
            sum(decisions.changed for decisions in some),
        )
