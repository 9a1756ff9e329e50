"""The robots' own edges between two nodes, and what follows for routes."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.reachability import RECOGNISED, left, reachability_of
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap

WORDS = {
    EdgeKind.MAPPED: "drove from one to the other while it mapped",
    EdgeKind.TURNED: "turned on the spot from one to the other",
    EdgeKind.DRIVEN: "has driven from one to the other",
    EdgeKind.LOOP: "has recognised one at the other",
    EdgeKind.MERGED: "has recognised one at the other",
}


def edge_in_words(edge: Edge) -> str:
    """An edge in words, for example `r0 turned on the spot from one to the other (edge r0.1.5)`."""
    return f"{edge.id.agent} {WORDS[edge.kind]} (edge {edge.id})"


def own_edge(merged: MergedMap, a: NodeId, b: NodeId) -> Edge | None:
    """The edge by which a robot's own map joins two nodes: how it drove or turned, else its surest claim.

    Claims that were refused join nothing.

    Args:
        merged: the merged map.
        a: the smaller id.
        b: the greater id.
    """
    if a.map != b.map:
        return None
    false = {refusal.edge for refusal in merged.refused if refusal.pair == (a, b)}
    edges = merged.maps[a.map].edges.values()
    own_edges = [edge for edge in edges if {edge.a, edge.b} == {a, b} and edge.id not in false]
    return min(
        own_edges,
        key=lambda e: (e.kind in CLAIMS, float(np.trace(e.a_from_b.covariance)), e.id),
        default=None,
    )


def claims(merged: MergedMap, a: NodeId, b: NodeId, named: Edge | None = None) -> Iterator[str]:
    """One sentence for each edge of a robot between two nodes.

    Args:
        merged: the merged map.
        a: the smaller id.
        b: the greater id.
        named: an edge that the reason names already; only its reachability is added.
    """
    refused = {r.edge: r.reason for r in merged.refused if r.edge is not None}
    for hybrid_map in merged.maps.values():
        for edge in hybrid_map.edges.values():
            if {edge.a, edge.b} != {a, b}:
                continue
            words = [] if named is not None and edge.id == named.id else [edge_in_words(edge)]
            if edge.id in refused:
                words.append(f"refused: {refused[edge.id]}")
            elif edge.kind in CLAIMS:
                words += ["believed"] if words else []
                words += [reach_words(merged, edge)] if edge.kind in RECOGNISED else []
            if words:
                yield "; ".join(words)


def consequences(merged: MergedMap, link: Link | None, a: NodeId, b: NodeId) -> Iterator[str]:
    """What follows for routes and for the two nodes' lives.

    Args:
        merged: the merged map.
        link: between the two, if there is one.
        a: the smaller id.
        b: the greater id.
    """
    if link is not None:
        yield f"the link {reach_words(merged, link.edge())}"
    for node in (a, b):
        if node in merged.superseded:
            yield f"{node} is superseded: {merged.superseded[node]}"


def reach_words(merged: MergedMap, edge: Edge) -> str:
    """Whether routes may use an edge; landmarks that have faded hold no servo."""
    a, b = (merged.maps[node.map].nodes[node] for node in (edge.a, edge.b))
    visible = left(edge.shared, a, b, (merged.faded.get(edge.a), merged.faded.get(edge.b)))
    words = reachability_of(replace(edge, shared=visible), a, b).reason
    faded = len(left(edge.shared, a, b)) - len(visible)
    return f"{words} ({faded} more have faded)" if faded else words
