"""What was superseded from merge to merge, so that the share of a map that is gone can be undone.

Which of two nodes of one place supersedes the other depends on what was superseded before, so a map has a
share in which nodes of other maps supersede each other. When it is retired, set apart, no longer joined with
others, or found to be one that may not be right, that is undone: the nodes of its component are what they
were before it was joined with them, and what has come since is judged again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Container, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.superseded import Superseded
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.merged_map import MergedMap

MOST = 4000
"""Changes that are kept. What is undone is judged again, 3 ms a node, while robots wait for the merge."""

Table = Mapping[NodeId, Superseded]


@dataclass(frozen=True)
class Changes:
    """What one merge or several changed.

    Attributes:
        before: what superseded the nodes before, of those of which that has changed.
        judged: nodes that had come, or had been written again.
        linked: pairs of nodes that had been linked.
    """

    before: dict[NodeId, Superseded | None] = field(default_factory=dict)
    judged: set[NodeId] = field(default_factory=set)
    linked: list[Pair] = field(default_factory=list)

    def __len__(self) -> int:
        """How much there is to keep."""
        return len(self.before) + len(self.judged) + len(self.linked) + 1


class SupersedingLog:
    """The last changes, and before which of them each map was joined with others."""

    def __init__(self, known: Iterable[MapId] = ()) -> None:
        """Begin with no changes.

        Args:
            known: maps that are merged already: there is nothing to undo of them.
        """
        self._steps: deque[Changes] = deque()
        self._forgotten = self._size = 0
        self._joined: dict[MapId, int] = dict.fromkeys(known, -1)
        self._unsure: Set[MapId] = frozenset()

    def follow(self, merged: MergedMap, unsure: Set[MapId]) -> int | None:
        """Take the next merged map, before anything is superseded in it.

        Args:
            merged: the map.
            unsure: maps that may not be right.

        Returns:
            The step before which maps were joined that no longer are, or that have become unsure; None if
            there is nothing to undo. Pruned maps have not gone: newer nodes have taken their place.
        """
        joined = {which for graph in merged.graphs if len(graph.maps) > 1 for which in graph.maps}
        left = self._joined.keys() - joined
        bad = (left - merged.pruned.maps) | (unsure - self._unsure)
        steps = [step for which in bad if (step := self._joined.get(which, -1)) >= self._forgotten]
        for which in left:
            del self._joined[which]
        now = self._forgotten + len(self._steps)
        for which in joined:
            self._joined.setdefault(which, now)
        self._unsure = frozenset(unsure)
        return min(steps, default=None)

    def undo(
        self, since: int, superseded: dict[NodeId, Superseded], nodes: Container[NodeId], maps: Set[MapId]
    ) -> Changes:
        """Undo what was superseded of some nodes, and forget these changes.

        Args:
            since: the first step that is undone.
            superseded: what is superseded; becomes what it was.
            nodes: which.
            maps: whose nodes they are; they are joined from now on.

        Returns:
            What is to be judged again: of all that came since.
        """
        undone = Changes()
        for step in reversed(list(self._steps)[since - self._forgotten :]):
            for node in [node for node in step.before if node in nodes]:
                before = step.before.pop(node)
                if before is None:
                    superseded.pop(node, None)
                else:
                    superseded[node] = before
            undone.judged.update(node for node in step.judged if node in nodes)
            step.judged.difference_update(undone.judged)
            linked = [pair for pair in step.linked if pair[0] in nodes and pair[1] in nodes]
            undone.linked.extend(linked)
            step.linked[:] = [pair for pair in step.linked if pair[0] not in nodes or pair[1] not in nodes]
        now = self._forgotten + len(self._steps)
        self._joined |= {which: now for which in maps if self._joined.get(which, -1) >= since}
        self._size = sum(map(len, self._steps))
        return undone

    def note(self, before: Table, now: Table, judged: Collection[NodeId], linked: Sequence[Pair]) -> None:
        """Keep what the next merge has changed.

        Args:
            before: what was superseded.
            now: what is.
            judged: nodes that have come, or were written again.
            linked: pairs that have been linked.
        """
        changed = (node for node in before.keys() | now.keys() if before.get(node) is not now.get(node))
        step = Changes({node: before.get(node) for node in changed}, set(judged), list(linked))
        self._steps.append(step)
        self._size += len(step)
        while self._size > MOST:
            self._size -= len(self._steps.popleft())
            self._forgotten += 1
