"""Rounds of believing links in a large merge, until there is nothing more to believe."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from hybridmap.node import MapId, NodeId
from merge.belief.groups import LinkGroup
from merge.belief.memory import Memory
from merge.graph.candidates import Pair
from merge.incremental.judgement import Judge
from merge.incremental.ledger import Ledger
from merge.incremental.sheets import Assembly, MapPair, Sheet
from merge.incremental.waiting import Waiting
from merge.merging import MergeSettings

Settle = Callable[[Assembly, set[NodeId], bool], Assembly]
"""Optimises around nodes of which links were believed. True: what was refused is heard once more then."""


def join(
    fresh: Iterable[MapPair],
    whole: Assembly,
    ledger: Ledger,
    sheets: Mapping[MapId, Sheet],
    groups: dict[MapPair, list[LinkGroup]],
    settings: MergeSettings,
    memory: Memory,
    settle: Settle,
) -> tuple[Assembly, int, set[Pair]]:
    """Believe links that the components bear out, and join components, as long as any can be.

    Args:
        fresh: maps between which links are to be judged.
        whole: the graph as it is.
        ledger: says which links are believed; it is told of more.
        sheets: of the island.
        groups: sorted links by maps; they are kept up to date.
        settings: of the merge.
        memory: of merges with the same settings.
        settle: optimises after each round.

    Returns:
        The graph then, how many links more are believed, and those that are not although they agree with each
        other beyond chance.
    """
    waiting = Waiting(ledger.waiting, whole)
    judge = Judge(settings, memory, sheets, groups, waiting)
    for maps in [maps for maps in groups if maps not in ledger.waiting]:
        del groups[maps]
    open_, heard, last, count = set(fresh), set(fresh), False, 0
    while True:
        for maps in judge.unsorted(open_):
            judge.sort(maps, {**ledger.believed(maps), **ledger.waiting.get(maps, {})})
        believed, refused, joins = judge.round(whole, open_, last)
        ledger.tell(refused)
        if not believed:
            if last:
                left = (pair for waits in ledger.waiting.values() for pair in waits)
                return whole, count, judge.agreed.intersection(left)
            whole = settle(whole, set(), True)
            open_, last = set(heard), True
            continue
        before = whole
        count += ledger.accept(believed)
        waiting.accept(believed)
        whole = Assembly(sheets, ledger.bundles)
        whole.lay_together(before, joins)
        whole.in_their_frames()
        whole = settle(whole, {node for link in believed for node in link.pair}, last)
        # What has come to lie within one component can be tested now.
        open_ = waiting.apart(before) | (heard if last else set())
        heard |= open_
