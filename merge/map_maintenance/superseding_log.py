"""What was superseded from merge to merge, so that the share of a map that is gone can be undone.

Which of two nodes of one place supersedes the other depends on what was superseded before, so a map has a
share in which nodes of other maps supersede each other. When it is retired, set apart, no longer joined with
others, or found to be one that may not be right, that is undone: the nodes that it was joined with are
superseded as they were before it came, and what has come since is judged again.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Set
from dataclasses import dataclass, replace
from itertools import accumulate

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.superseded import Superseded
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.merged_map import MergedMap

MOST = 4000
"""Changes that are kept. What is undone is judged again, 3 ms a node, while robots wait for the merge."""

Table = Mapping[NodeId, Superseded]


@dataclass(frozen=True)
class Changes:
    """What one merge changed, less what was undone since.

    Attributes:
        before: what superseded the nodes before, of those of which that has changed.
        judged: nodes that had come, or had been written again.
        linked: pairs of nodes that had been linked.
    """

    before: Mapping[NodeId, Superseded | None]
    judged: Set[NodeId]
    linked: Set[Pair]

    def __len__(self) -> int:
        """How much there is to keep."""
        return len(self.before) + len(self.judged) + len(self.linked)


@dataclass(frozen=True)
class Undone:
    """What is to be judged again.

    Attributes:
        judged: nodes that had come since, or had been written again.
        linked: pairs of nodes that had been linked since.
    """

    judged: Set[NodeId] = frozenset()
    linked: Set[Pair] = frozenset()


@dataclass(frozen=True)
class SupersedingLog:
    """The last changes, and which maps were joined with each other since when.

    Attributes:
        steps: changes, the oldest first.
        joined: components of several maps; each map with the number of the step before which it was joined
            with others, -1 if that is forgotten.
    """

    steps: tuple[Changes, ...] = ()
    joined: tuple[Mapping[MapId, int], ...] = ()

    def followed(
        self,
        merged: MergedMap,
        doubted: Set[MapId],
        superseded: dict[NodeId, Superseded],
        nodes: Container[NodeId],
    ) -> tuple[SupersedingLog, Undone]:
        """Take the next merged map, and undo what maps had a share in that are no longer joined or right.

        Pruned maps have not gone: newer nodes have taken their place.

        Args:
            merged: the map, before anything is superseded in it.
            doubted: maps that may not be right, and of which that was not so before.
            superseded: what is superseded; it becomes what it was.
            nodes: of components that were solved again.

        Returns:
            The log without what was undone, and that.
        """
        parts = [graph.maps for graph in merged.graphs if len(graph.maps) > 1]
        since = {which: step for part in self.joined for which, step in part.items()}
        bad = (since.keys() - merged.pruned.maps).difference(*parts) | doubted
        starts: dict[MapId, int] = {}
        for part in self.joined:
            steps = [part[which] for which in bad & part.keys() if part[which] >= 0]
            if steps:
                starts |= dict.fromkeys(part, min(steps))
        log, undone = self._undone(starts, superseded, nodes)
        now = len(self.steps)
        since |= {which: now for which, start in starts.items() if since[which] >= start}
        joined = tuple({which: since.get(which, now) for which in sorted(part)} for part in parts)
        return replace(log, joined=joined), undone

    def _undone(
        self, starts: Mapping[MapId, int], superseded: dict[NodeId, Superseded], nodes: Container[NodeId]
    ) -> tuple[SupersedingLog, Undone]:
        """Undo what was superseded of some maps' nodes.

        Args:
            starts: from which step on, by map.
            superseded: see `followed`; likewise nodes.
            nodes: which.
        """
        if not starts:
            return self, Undone()
        steps, judged, linked, restored = list(self.steps), set[NodeId](), set[Pair](), set[NodeId]()
        for k in reversed(range(min(starts.values()), len(steps))):
            mine = {which for which, start in starts.items() if start <= k}
            undone = {node for node in steps[k].before if node.map in mine and node in nodes}
            for node in undone:
                before = steps[k].before[node]
                if before is None:
                    superseded.pop(node, None)
                else:
                    superseded[node] = before
            restored |= undone
            again = {node for node in steps[k].judged if node.map in mine and node in nodes}
            pairs = {
                (a, b) for a, b in steps[k].linked if {a.map, b.map} <= mine and a in nodes and b in nodes
            }
            judged |= again
            linked |= pairs
            left = {node: before for node, before in steps[k].before.items() if node not in undone}
            steps[k] = Changes(left, steps[k].judged - again, steps[k].linked - pairs)
        # What superseded a node then may itself be superseded by one that was not with them.
        stale = {node for node in restored & superseded.keys() if superseded[node].by in superseded}
        for node in stale:
            del superseded[node]
        return replace(self, steps=tuple(steps)), Undone(judged | stale, linked)

    def noted(
        self, before: Table, now: Table, judged: Collection[NodeId], linked: Collection[Pair]
    ) -> SupersedingLog:
        """Keep what the next merge has changed.

        Args:
            before: what was superseded.
            now: what is.
            judged: nodes that have come, or were written again.
            linked: pairs that have been linked.
        """
        differ = [node for node in before.keys() | now.keys() if before.get(node) != now.get(node)]
        step = Changes({n: before.get(n) for n in sorted(differ)}, frozenset(judged), frozenset(linked))
        steps = [*self.steps, step]
        size, gone = sum(map(len, steps)), 0
        while size > MOST:
            size -= len(steps[gone])
            gone += 1
        # All of a step may have been undone.
        numbers = [-1] * gone + list(accumulate((len(one) > 0 for one in steps[gone:]), initial=0))
        joined = tuple({which: numbers[k] if k >= 0 else k for which, k in p.items()} for p in self.joined)
        return SupersedingLog(tuple(one for one in steps[gone:] if len(one)), joined)
