"""Doubts: when what was decided of links is decided again, and of which.

A robot that drives through the same rooms every day leaves nodes behind for which newer ones stand. What was
decided of their links had all evidence of its day, and nobody compares anything with them any more. If all of
it were decided again whenever something comes, a merge would take longer with every drive. So it stands until

- one of those links is refused by what comes: it strains too much, or robots clash under it,
- a component comes apart,
- links that agree with each other beyond chance are not believed, whether they contradict what stands or do
  not join what they would; if they were not either when all was decided last, it stands,
- people rule otherwise,
- or the map has doubled since all was decided last.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set

from hybridmap.node import MapId, NodeId
from hybridmap.ruling import Rulings
from merge.graph.candidates import Pair
from merge.incremental.settings import StepSettings
from merge.incremental.sheets import Assembly, Sheet

DOUBLED = 2.0
"""So many times as many measurements as when all was decided last, and all is decided again."""


class Doubts:
    """Of one island.

    Attributes:
        past: nodes of another day for which others stand.
        labels: of the components of all nodes at the end of the last step.
        since: measurements that have come or gone since anything was decided again.
        trusted: what it begins with was decided by another process, all of it.
    """

    def __init__(self, settings: StepSettings) -> None:
        """No reason to doubt anything.

        Args:
            settings: when anything is decided again.
        """
        self.past: Set[NodeId] = frozenset()
        self.labels: Mapping[NodeId, int] = {}
        self.since, self.trusted = 0, False
        self._settings = settings
        self._count = self._decided = self._nodes = 0
        self._rulings: Rulings | None = None
        self._contradicting: set[Pair] = set()
        self._doubtful = False

    @property
    def small(self) -> bool:
        """Whether all of it can be decided again within a step."""
        return self._nodes <= self._settings.whole_up_to

    @property
    def due(self) -> bool:
        """Whether something should be decided again: what is not past, or everything."""
        return self.doubtful or self.since > self._settings.whole_share * max(self._count, 1)

    @property
    def doubtful(self) -> bool:
        """Whether something speaks against what was decided of links at past nodes."""
        return self._doubtful and bool(self.past)

    @property
    def everything(self) -> bool:
        """Whether that is everything, or what was decided of links at past nodes stands."""
        return not self.past or self._doubtful or self._count > DOUBLED * self._decided

    @property
    def within(self) -> bool:
        """Whether that can be done within a step."""
        return self._nodes - (0 if self.everything else len(self.past)) <= self._settings.whole_up_to

    def begin(self, sheets: Mapping[MapId, Sheet], past: Set[NodeId], rulings: Rulings) -> Set[NodeId]:
        """A step begins.

        Args:
            sheets: of the island.
            past: nodes of another day for which others stand; those that are not there are left out.
            rulings: of people.

        Returns:
            Those of them at which what was decided stands in this step: none if people have ruled otherwise,
            or nodes have come back.
        """
        ruled = self._rulings is not None and {*rulings.in_force} != {*self._rulings.in_force}
        stands = not ruled and past >= self.past
        self._doubtful |= ruled
        self.past = {node for node in past if node.map in sheets and node in sheets[node.map].rows}
        self._rulings = rulings
        self._nodes = sum(len(sheet.nodes) for sheet in sheets.values())
        return self.past if stands else frozenset()

    def lost(self, pairs: Iterable[Pair]) -> None:
        """Links that were believed do not hold."""
        gone = set(pairs)
        self.since += len(gone)
        self._doubtful |= any(not self.past.isdisjoint(pair) for pair in gone)

    def end(self, sheets: Mapping[MapId, Sheet], whole: Assembly, against: Set[Pair], decided: bool) -> None:
        """Something was decided.

        Args:
            sheets: of the island.
            whole: the graph of all.
            against: links that agree beyond chance and are not believed.
            decided: whether everything was decided: then it stands in spite of them.
        """
        now, parts = whole.label_of(), dict[int, int]()
        for name in (piece.name for one in sheets.values() for piece in one.fragments):
            before = self.labels.get(name)
            if before is not None and parts.setdefault(before, now[name]) != now[name]:
                self._doubtful = True
        self.labels, self._count = now, len(whole.factors)
        self._doubtful |= not self.trusted and not against <= self._contradicting
        self._contradicting |= against
        if self.trusted or decided:
            self._decided, self.trusted = self._count, False
        if decided:
            self._doubtful, self._contradicting = False, set(against)
