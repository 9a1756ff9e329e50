"""What was superseded from merge to merge, so that the share of a map that is gone can be undone.

Which of two nodes of one place supersedes the other depends on what was superseded before, so a map has a
share in which nodes of other maps supersede each other. When it is retired, set apart, no longer joined with
others, or found to be one that may not be right, that is undone: the nodes that it was joined with are
superseded as they were before it came, and what has come since is judged again. Where maps part that are all
there still, that is a change like others: a map that is retired later may have been the cause of it.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Set
from dataclasses import dataclass, field, replace
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
        cut: pairs of nodes that were linked no more.
        parted: components before that were no longer one; each map with the number of the step before which
            it had been joined.
    """

    before: Mapping[NodeId, Superseded | None]
    judged: Set[NodeId]
    linked: Set[Pair]
    cut: Set[Pair] = frozenset()
    parted: tuple[Mapping[MapId, int], ...] = ()

    def __len__(self) -> int:
        """How much there is to keep."""
        lists = (self.before, self.judged, self.linked, self.cut, *self.parted)
        return sum(map(len, lists))

    def without(self, pruned: Set[NodeId]) -> Changes:
        """Without nodes that have left for good; one that such a node superseded before is to be judged."""
        here = {node: was for node, was in self.before.items() if node not in pruned}
        again = {node for node, was in here.items() if was is not None and was.by in pruned}
        linked, cut = ({p for p in pairs if pruned.isdisjoint(p)} for pairs in (self.linked, self.cut))
        judged = (self.judged | again) - pruned
        return Changes(here | dict.fromkeys(again), judged, linked, cut, self.parted)


@dataclass(frozen=True)
class Undone:
    """What was undone before a merge.

    Attributes:
        before: what was superseded then; `noted` keeps what has changed since.
        judged: nodes that had come since, or had been written again; they are judged again.
        linked: pairs of nodes that had been linked since, likewise.
        known: pairs that had been linked before, and cut since: a link between them is nothing new.
        parted_judged: the same as `judged`, of maps that have parted: the log has them where they came.
        parted_linked: likewise.
        parted: see `Changes`.
    """

    before: Table = field(default_factory=dict)
    judged: Set[NodeId] = frozenset()
    linked: Set[Pair] = frozenset()
    known: Set[Pair] = frozenset()
    parted_judged: Set[NodeId] = frozenset()
    parted_linked: Set[Pair] = frozenset()
    parted: tuple[Mapping[MapId, int], ...] = ()


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
        there = {which for graph in merged.graphs for which in graph.maps}
        since = {which: step for part in self.joined for which, step in part.items()}
        left = (since.keys() - merged.pruned.maps).difference(*parts)
        starts: dict[MapId, int] = {}
        for which in ((left - there) | doubted) & since.keys():
            step = since[which]
            for other in self._together(which, step) if step >= 0 else ():
                starts[other] = min(starts.get(other, step), step)
        log, undone = self._undone(starts, superseded, nodes)
        before, now = dict(superseded), len(self.steps)
        # They are joined since when they were, as if they had never parted.
        for k, changes in reversed([*enumerate(self.steps)]):
            for part in changes.parted:
                since |= {which: step for which, step in part.items() if starts.get(which, now) <= k}
        since |= {which: now for which, start in starts.items() if since.get(which, now) >= start}
        starts = {}
        for part in self.joined:
            steps = [since[which] for which in left & there & part.keys() if since[which] >= 0]
            if steps:
                starts |= dict.fromkeys(part, min(steps))
        _, again = log._undone(starts, superseded, nodes)
        joined = tuple({which: since.get(which, now) for which in sorted(part)} for part in parts)
        whole = [part.keys() & there for part in self.joined]
        parted = tuple(
            {which: since[which] for which in sorted(part)}
            for part in whole
            if len(part) > 1 and not any(part <= other for other in parts)
        )
        return replace(log, joined=joined), replace(
            undone, before=before, parted_judged=again.judged, parted_linked=again.linked, parted=parted
        )

    def _together(self, which: MapId, start: int) -> set[MapId]:
        """Maps that were in one component with a map, or with one that was, from some step on."""
        groups = [{*part} for part in self.joined]
        groups += [{*part} for step in self.steps[start:] for part in step.parted]
        out, size = {which}, 0
        while len(out) > size:
            size = len(out)
            for group in groups:
                if not group.isdisjoint(out):
                    out |= group
        return out

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
        steps, judged, restored = list(self.steps), set[NodeId](), set[NodeId]()
        linked, known = set[Pair](), set[Pair]()
        for k in reversed(range(min(starts.values()), len(steps))):
            step, mine = steps[k], {which for which, start in starts.items() if start <= k}
            undone = {node for node in step.before if node.map in mine and node in nodes}
            for node in undone:
                before = step.before[node]
                if before is None:
                    superseded.pop(node, None)
                else:
                    superseded[node] = before
            restored |= undone
            again = {node for node in step.judged if node.map in mine and node in nodes}
            come, cut = (
                {(a, b) for a, b in pairs if {a.map, b.map} <= mine and a in nodes and b in nodes}
                for pairs in (step.linked, step.cut)
            )
            judged |= again
            linked, known = (linked | come) - cut, (known | cut) - come
            left = {node: before for node, before in step.before.items() if node not in undone}
            parted = tuple(part for part in step.parted if not part.keys() <= mine)
            steps[k] = Changes(left, step.judged - again, step.linked - come, step.cut - cut, parted)
        # What superseded a node then may itself be superseded by one that was not with them.
        stale = {node for node in restored & superseded.keys() if superseded[node].by in superseded}
        for node in stale:
            del superseded[node]
        return replace(self, steps=tuple(steps)), Undone({}, judged | stale, linked, known)

    def noted(
        self,
        now: Table,
        undone: Undone,
        judged: Set[NodeId],
        linked: Set[Pair],
        cut: Set[Pair],
        pruned: Set[NodeId] = frozenset(),
    ) -> SupersedingLog:
        """Keep what the next merge has changed.

        Args:
            now: what is superseded.
            undone: before it.
            judged: nodes that have come, or were written again.
            linked: pairs that have been linked.
            cut: pairs that are linked no more.
            pruned: nodes that have left the merged map for good; nothing is remembered of them.
        """
        before = undone.before
        differ = sorted(node for node in before.keys() | now.keys() if before.get(node) != now.get(node))
        changes = {node: before.get(node) for node in differ}
        step = Changes(changes, frozenset(judged), frozenset(linked), frozenset(cut), undone.parted)
        steps = [*self.steps, step]
        if pruned:
            steps = [one.without(pruned) for one in steps]
        size, gone = sum(map(len, steps)), 0
        while size > MOST:
            size -= len(steps[gone])
            gone += 1
        # All of a step may have been undone.
        numbers = [-1] * gone + list(accumulate((len(one) > 0 for one in steps[gone:]), initial=0))

        def renumbered(parts: tuple[Mapping[MapId, int], ...]) -> tuple[Mapping[MapId, int], ...]:
            return tuple({which: numbers[k] if k >= 0 else k for which, k in part.items()} for part in parts)

        kept = (replace(one, parted=renumbered(one.parted)) for one in steps[gone:] if len(one))
        return SupersedingLog(tuple(kept), renumbered(self.joined))
