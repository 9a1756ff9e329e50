"""What robots themselves say of two nodes by the edges of their maps, and what follows for routes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.node import Edge, EdgeKind, NodeId
from mapweave.hybridmap.reachability import RECOGNISED, left, reachability_of
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap

SAID = {
    EdgeKind.MAPPED: "drove from the one to the other while it mapped",
    EdgeKind.TURNED: "turned on the spot from the one to the other",
    EdgeKind.DRIVEN: "has driven from the one to the other",
    EdgeKind.LOOP: "has recognised the one at the other",
    EdgeKind.MERGED: "has recognised the one at the other",
}


def said(edge: Edge) -> str:
    """For example `r0 turned on the spot from the one to the other (edge r0.1.5)`."""
    return f"{edge.id.agent} {SAID[edge.kind]} (edge {edge.id})"


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
    found = [edge for edge in edges if {edge.a, edge.b} == {a, b} and edge.id not in false]
    return min(
        found, key=lambda e: (e.kind in CLAIMS, float(np.trace(e.a_from_b.covariance)), e.id), default=None
    )


def claims(merged: MergedMap, a: NodeId, b: NodeId, told: Edge | None = None) -> Iterator[str]:
    """One sentence for each edge of a robot between two nodes.

    Args:
        merged: the merged map.
        a: the smaller id.
        b: the greater id.
        told: an edge of which the reason tells already; only whether it can be driven is left to say.
    """
    refused = {r.edge: r.reason for r in merged.refused if r.edge is not None}
    for one in merged.maps.values():
        for edge in one.edges.values():
            if {edge.a, edge.b} != {a, b}:
                continue
            words = [] if told is not None and edge.id == told.id else [said(edge)]
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
    there = left(edge.shared, a, b, (merged.faded.get(edge.a), merged.faded.get(edge.b)))
    words = reachability_of(replace(edge, shared=there), a, b).reason
    faded = len(left(edge.shared, a, b)) - len(there)
    return f"{words} ({faded} more have faded)" if faded else words
