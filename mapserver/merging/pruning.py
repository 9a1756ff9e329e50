"""Pruning: superseded nodes leave the map for good, so that a map that is driven through for years stays small.

A node that has been superseded without a break for `keep_superseded_days` is marginalised
(mapweave.merge.pose_graph.marginalization). What is left of it: marginal links between the nodes that remain,
and a line that says which node stands for its place. The server alone decides this, and records it with its
store (mapweave.mapserver.log.store.Store.prune), so that everyone who reads the store gets the same map.

Some superseded nodes stay: the first of each component, which gives the component its frame; those that a
person's words or constraints name; those of maps with anything held against them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, fields, is_dataclass

from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.node import EdgeId, MapId, NodeId
from mapweave.hybridmap.pruned_node import PrunedNode, PrunedNodes
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.marginalization import MARGINAL, is_marginal, marginal_links
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.messages import KeptPruned, KeptPruning, decode, encode

DAY_NS = 86_400_000_000_000
STATE = "pruning"
"""Among the results of a store."""
PART = "pruned {}"
"""Likewise, with a number: what was pruned at one time."""


@dataclass(frozen=True)
class PrunePlan:
    """What is pruned at one time.

    Attributes:
        nodes: with what is left of each.
        edges: robots' edges at them.
        marginals: all marginal links from then on.
    """

    nodes: Mapping[NodeId, PrunedNode]
    edges: tuple[EdgeId, ...]
    marginals: tuple[Link, ...]


class Pruning:
    """Since when nodes are superseded, and what is left of those that were pruned.

    Attributes:
        pruned: nodes that have left the map.
        marginals: links that are left of them.
    """

    def __init__(self) -> None:
        """Nothing was pruned yet."""
        self.pruned = PrunedNodes()
        self.marginals: tuple[Link, ...] = ()
        self._since: dict[NodeId, int] = {}
        self._looked_ns = 0
        self._parts = 0

    def due(self, superseded: Collection[NodeId], now_ns: int, keep_days: float) -> set[NodeId]:
        """Nodes that are superseded for long enough. There are none but once a day.

        Args:
            superseded: by the newest merge.
            now_ns: the server's clock.
            keep_days: for so long they are kept.
        """
        self._since = {node: min(self._since.get(node, now_ns), now_ns) for node in superseded}
        if now_ns - self._looked_ns < DAY_NS and now_ns >= self._looked_ns:
            return set()
        self._looked_ns = now_ns
        return {node for node, since in self._since.items() if now_ns - since >= keep_days * DAY_NS}

    def take(self, plan: PrunePlan) -> None:
        """It is done."""
        self.marginals = plan.marginals
        self.pruned = PrunedNodes({**self.pruned.nodes, **plan.nodes})
        self._parts += 1
        for node in plan.nodes:
            del self._since[node]

    def records(self, plan: PrunePlan) -> dict[str, bytes]:
        """Results of the store that say what this will be when a plan is done; see `restore`."""
        links = tuple(Linked.of(link.a, link.b, link.a_from_b) for link in plan.marginals)
        since = tuple((node, stamp) for node, stamp in self._since.items() if node not in plan.nodes)
        state = KeptPruning(links, since, self._looked_ns, self._parts + 1)
        return {
            STATE: encode(state),
            PART.format(self._parts): encode(KeptPruned(tuple(plan.nodes.items()))),
        }

    def restore(self, records: Iterator[bytes | None]) -> None:
        """Read it again.

        Args:
            records: the results `STATE`, and each `PART` from 0, as they are asked for.

        Raises:
            InvalidMessage: a record is damaged.
        """
        state = next(records)
        if state is None:
            return
        kept = decode(state, KeptPruning)
        nodes: dict[NodeId, PrunedNode] = {}
        for number in range(kept.parts):
            part = next(records)
            if part is None:
                raise InvalidMessage(f"part {number} is missing")
            nodes.update(decode(part, KeptPruned).nodes)
        self.pruned, self._since = PrunedNodes(nodes), dict(kept.since)
        self.marginals = tuple(Link(k.a, k.b, k.a_from_b, evidence={MARGINAL: 1.0}) for k in kept.links)
        self._looked_ns, self._parts = kept.looked_ns, kept.parts


def left_of(
    merged: MergedMap, due: Set[NodeId], marginals: Iterable[Link], now_ns: int
) -> tuple[dict[NodeId, PrunedNode], list[Link]]:
    """What is left of superseded nodes of a merged map.

    Args:
        merged: the map.
        due: of its superseded nodes those that shall leave it; some of them stay all the same, see the module.
        marginals: links that are left of nodes before them.
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
        earlier = [links[pair] for pair in sorted(links.keys() & in_force) if pair[0] in graph.rows]
        for link in earlier:
            del links[link.pair]
        links |= {link.pair: link for link in marginal_links(graph, removed, earlier)}
        for node in sorted(removed):
            by = merged.superseded[node].by
            by_from_node = merged.pose(by).inverse() @ merged.pose(node)
            nodes[node] = PrunedNode(by, by_from_node, now_ns)
    return nodes, [links[pair] for pair in sorted(links)]


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
