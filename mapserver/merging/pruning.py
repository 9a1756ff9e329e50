"""Pruning: superseded nodes leave the map for good, so that it stays small when it is driven for years.

A node that has been superseded without a break for `keep_superseded_days` is marginalised
(mapweave.merge.pose_graph.marginalization). What is left of it: marginal links between the nodes that remain,
and a line that says which node replaces it. The server alone decides this, and records it with its
store (mapweave.mapserver.log.store.Store.prune), so that everyone who reads the store gets the same map.

Some superseded nodes stay: the first of each component, which gives the component its frame; those that a
person's words or constraints name; those of maps with anything held against them.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.explanation import MARGINAL
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.pruned_node import PrunedNode, PrunedNodes
from mapweave.mapserver.log.store import PRUNING
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.marginalization import is_marginal, marginal_links
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.messages import KeptPruned, KeptPruning, decode, encode

log = logging.getLogger(__name__)

DAY_NS = 86_400_000_000_000
AT_ONCE = 300
"""Nodes of one component that leave at once, near each other; the others on the days after. The merge waits
for it: for 300 about two seconds."""
PART = "pruned {}"
"""Among the results of a store, with a number: what is left of some nodes."""
PART_NODES = 500
"""A part with as many is full, and is not written again. A row for each day would leave much of its page
empty."""


@dataclass(frozen=True)
class PrunePlan:
    """What is pruned at one time.

    Attributes:
        nodes: with what is left of each.
        edges: robots' edges at them.
        marginals: all marginal links from then on.
        standing: all verified links that are not decided again from then on, by their nodes.
    """

    nodes: Mapping[NodeId, PrunedNode]
    edges: tuple[EdgeId, ...]
    marginals: tuple[Link, ...]
    standing: frozenset[Pair]


class Pruning:
    """Since when nodes are superseded, and what is left of those that were pruned.

    Attributes:
        pruned: nodes that have left the map.
        marginals: links that are left of them.
        standing: verified links that were decided by what is gone, by their nodes.
    """

    def __init__(self, marginals: Iterable[Link] = (), standing: Iterable[Pair] = ()) -> None:
        """Nothing was pruned yet but, elsewhere, that of which these links are left; see the attributes."""
        self.pruned = PrunedNodes()
        self.marginals = tuple(marginals)
        self.standing = frozenset(standing)
        self._since: dict[NodeId, int] = {}
        self._linked_since: dict[Pair, int] = {}
        self._looked_ns = 0
        self._restored = False
        # The parts that are full, and what is in the next one.
        self._parts = 0
        self._part: dict[NodeId, PrunedNode] = {}

    def due(self, merged: MergedMap, now_ns: int, keep_days: float) -> tuple[set[NodeId], set[Pair]] | None:
        """Nodes that are superseded, and pairs that are linked, for long enough.

        The time since the last look of another process counts as half of `keep_days` at most: one of the two
        clocks may be wrong, and a node that leaves does not come back.

        Args:
            merged: by the newest merge.
            now_ns: the server's clock.
            keep_days: for so long they are kept.

        Returns:
            None: it is not asked more often than once a day.
        """
        self._doubt(now_ns, round(keep_days * DAY_NS / 2))
        self._since = {node: min(self._since.get(node, now_ns), now_ns) for node in merged.superseded}
        linked = self._linked_since
        self._linked_since = {
            link.pair: min(linked.get(link.pair, now_ns), now_ns)
            for link in merged.links
            if not is_marginal(link)
        }
        # A clock that was put back must not hold it up.
        if 0 <= now_ns - self._looked_ns < DAY_NS:
            return None
        self._looked_ns = now_ns
        least = now_ns - keep_days * DAY_NS
        lasting = {pair for pair, since in self._linked_since.items() if since <= least}
        # What a link says stays for good: one that was believed only now may not be true.
        doubted = {node for pair in self._linked_since.keys() - lasting for node in pair}
        return {node for node, since in self._since.items() if since <= least} - doubted, lasting

    def put_forward(self, leap_ns: int) -> None:
        """The server's clock was put forward: nothing is superseded for longer by that.

        Args:
            leap_ns: by so much.
        """
        self._since = {node: since + leap_ns for node, since in self._since.items()}
        self._linked_since = {pair: since + leap_ns for pair, since in self._linked_since.items()}
        self._looked_ns += leap_ns

    def _doubt(self, now_ns: int, most_ns: int) -> None:
        """Have no more than so much time pass between the last look of another process and now."""
        restored, self._restored = self._restored, False
        passed = now_ns - self._looked_ns
        if restored and passed > most_ns:
            log.info(
                "what is superseded was looked at %.1f days ago, by this clock: that counts as %.1f days",
                passed / DAY_NS, most_ns / DAY_NS,
            )  # fmt: skip
            self.put_forward(passed - most_ns)

    def take(self, plan: PrunePlan) -> None:
        """It is done."""
        if plan.nodes:
            self.marginals, self.standing = plan.marginals, plan.standing
            self.pruned = PrunedNodes({**self.pruned.nodes, **plan.nodes})
            self._part |= plan.nodes
            if len(self._part) >= PART_NODES:
                self._parts, self._part = self._parts + 1, {}
        self._since = {node: stamp for node, stamp in self._since.items() if node not in plan.nodes}
        self._linked_since = {
            pair: stamp for pair, stamp in self._linked_since.items() if plan.nodes.keys().isdisjoint(pair)
        }

    def records(self, plan: PrunePlan) -> dict[str, bytes]:
        """Results of the store that say what this will be when a plan is done; see `restore`."""
        links = tuple(Linked.of(link.a, link.b, link.a_from_b) for link in plan.marginals)
        since = tuple((node, stamp) for node, stamp in self._since.items() if node not in plan.nodes)
        linked_since = tuple(
            (*pair, stamp) for pair, stamp in self._linked_since.items() if plan.nodes.keys().isdisjoint(pair)
        )
        part = {**self._part, **plan.nodes}
        parts = self._parts + bool(part)
        state = encode(KeptPruning(links, tuple(plan.standing), since, linked_since, self._looked_ns, parts))
        if not plan.nodes:
            return {PRUNING: state}
        return {PRUNING: state, PART.format(self._parts): encode(KeptPruned(tuple(part.items())))}

    def restore(self, result: Callable[[str], bytes | None]) -> None:
        """Read it again.

        Args:
            result: gives what is stored by a name.

        Raises:
            InvalidMessage: a record is damaged.
        """
        state = result(PRUNING)
        if state is None:
            return
        kept = decode(state, KeptPruning)
        nodes: dict[NodeId, PrunedNode] = {}
        self._parts, self._part = kept.parts, {}
        for number in range(kept.parts):
            value = result(PART.format(number))
            part = dict(decode(value, KeptPruned).nodes if value else ())
            nodes |= part
            if number == kept.parts - 1 and len(part) < PART_NODES:
                self._parts, self._part = number, part
        self.pruned, self._since = PrunedNodes(nodes), dict(kept.since)
        self.marginals = tuple(marginal_of(link) for link in kept.links)
        self.standing = frozenset(kept.standing)
        self._linked_since = {(a, b): stamp for a, b, stamp in kept.linked_since}
        self._looked_ns, self._restored = kept.looked_ns, True


def marginal_of(kept: Linked) -> Link:
    """A marginal link as it is kept."""
    return Link(kept.a, kept.b, kept.a_from_b, evidence={MARGINAL: 1.0})


def plan_of(
    merged: MergedMap,
    maps: Iterable[HybridMap],
    pruning: Pruning,
    now_ns: int,
    keep_days: float,
    stays: Callable[[NodeId], bool] = lambda node: False,
) -> PrunePlan | None:
    """What is to be pruned after a merge; None: it is not asked more often than once a day.

    Args:
        merged: the merged map.
        maps: of which it was made.
        pruning: so far.
        now_ns: the server's clock.
        keep_days: superseded nodes are kept for so long.
        stays: whether a node is not pruned in any case.
    """
    due = pruning.due(merged, now_ns, keep_days)
    if due is None:
        return None
    superseded, linked = due
    open_ = {link.pair for link in merged.links if not is_marginal(link)} - linked - pruning.standing
    open_ |= {refusal.pair for refusal in merged.refused if refusal.link is not None}
    leaving = {node for node in superseded if not stays(node)}
    nodes, marginals = left_of(merged, leaving, pruning.marginals, open_, now_ns)
    # What was decided with the help of the nodes that go cannot be decided again without them.
    parts = {merged.component_of(node) for node in nodes}
    standing = {pair for pair in linked if merged.component_of(pair[0]) in parts} | pruning.standing
    standing = {pair for pair in standing if nodes.keys().isdisjoint(pair)}
    edges = {edge.id for hybrid_map in maps for node in nodes for edge in hybrid_map.edges_at(node)}
    return PrunePlan(nodes, tuple(sorted(edges)), tuple(marginals), frozenset(standing))


def left_of(
    merged: MergedMap, due: Set[NodeId], marginals: Iterable[Link], taken: Set[Pair], now_ns: int
) -> tuple[dict[NodeId, PrunedNode], list[Link]]:
    """What is left of superseded nodes of a merged map.

    Args:
        merged: the map.
        due: of its superseded nodes those that shall leave it; some stay all the same, see the module.
        marginals: links that are left of nodes before them.
        taken: pairs with verified links that may yet be decided otherwise.
        now_ns: the time, ns since 1970.

    Returns:
        The nodes that leave, and all marginal links from then on.
    """
    held = {*merged.accusations(), *merged.constraints.retired}
    in_force = {link.pair for link in merged.links if is_marginal(link)}
    links = {link.pair: link for link in marginals}
    nodes: dict[NodeId, PrunedNode] = {}
    for graph in merged.graphs:
        removed = {node for node in graph.nodes[1:] if node in due and node.map not in held}
        if not removed or not isinstance(graph, Component):
            continue
        removed = _nearest(graph, removed)
        earlier = [links[pair] for pair in sorted(links.keys() & in_force) if pair[0] in graph.rows]
        for link in earlier:
            del links[link.pair]
        links |= {link.pair: link for link in marginal_links(graph, removed, earlier, taken)}
        for node in sorted(removed):
            by = merged.superseded[node].by
            by_from_node = merged.pose(by).inverse() @ merged.pose(node)
            nodes[node] = PrunedNode(by, by_from_node, now_ns)
    return nodes, [links[pair] for pair in sorted(links)]


def _nearest(graph: Component, nodes: Set[NodeId]) -> set[NodeId]:
    """Those nodes that are nearest to the first of them, at most `AT_ONCE`."""
    names = sorted(nodes)
    places = graph.means[graph.index(names), :2]
    order = np.argsort(np.linalg.norm(places - places[0], axis=1), kind="stable")
    return {names[k] for k in order[:AT_ONCE].tolist()}


def named_nodes(value: object) -> Iterator[NodeId]:
    """All nodes that a value of dataclasses and tuples names."""
    if isinstance(value, NodeId):
        yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from named_nodes(getattr(value, field.name))
    elif isinstance(value, tuple) and not isinstance(value, MapId):
        for item in value:
            yield from named_nodes(item)
