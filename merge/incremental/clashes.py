"""Clashes that a step may have made: robots of maps that changed, and those around them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import networkx as nx
import numpy as np

from hybridmap.node import MapId, NodeId
from merge.belief.joining import Solver
from merge.bodies.refutation import SIGHT, Refutation
from merge.graph.fragments import Fragment
from merge.graph.links import Link
from merge.incremental.graph import WideGraph
from merge.incremental.sheets import Assembly, Bundle, MapPair, Sheet
from merge.merging import MergeSettings

Key = tuple[NodeId, NodeId]
"""Names of two fragments, smaller first."""


def neighbours(sheets: Mapping[MapId, Sheet], changed: set[MapId]) -> list[MapId]:
    """Maps that changed and those whose nodes come near theirs, if any of them has a clock."""
    boxes = {
        map_id: (sheet.means[:, :2].min(axis=0) - SIGHT / 2, sheet.means[:, :2].max(axis=0) + SIGHT / 2)
        for map_id, sheet in sheets.items()
        if len(sheet.nodes) and sheet.clocked
    }
    near = {
        other
        for map_id in changed & boxes.keys()
        for other, (low, high) in boxes.items()
        if np.all(low <= boxes[map_id][1]) and np.all(high >= boxes[map_id][0])
    }
    return sorted(near)


def clashing(
    sheets: Mapping[MapId, Sheet],
    some: Sequence[MapId],
    graphs: Sequence[WideGraph],
    kept: Sequence[Link],
    fallen: Iterable[Link],
    settings: MergeSettings,
) -> tuple[dict[Key, str], Refutation]:
    """Groups of links that must fall, with reasons, and who says so.

    Args:
        sheets: of the island.
        some: maps whose robots may clash.
        graphs: the components that hold their nodes.
        kept: believed links between them.
        fallen: links that were refuted before.
        settings: of the merge.
    """
    fragments: list[Fragment] = [piece for one in some for piece in sheets[one].fragments]
    maps = {one: sheets[one].one for one in some}
    refutation = Refutation(maps, Solver(fragments), settings.consistency, settings.exclusion)
    try:
        return refutation.impossible(graphs, kept, refutation.keys_of(fallen)), refutation
    except (nx.NetworkXNoPath, nx.NodeNotFound):
        # They are joined by way of maps that are not among these: the next merge made anew will tell.
        return {}, refutation


def falling(
    sheets: Mapping[MapId, Sheet],
    bundles: Mapping[MapPair, Bundle],
    whole: Assembly,
    changed: set[MapId],
    fallen: Iterable[Link],
    settings: MergeSettings,
) -> list[tuple[list[Link], str]]:
    """Links that must fall together, with reasons: under them robots would walk through each other.

    Args:
        sheets: of the island.
        bundles: links that are believed.
        whole: the graph that they make.
        changed: maps whose nodes may have moved.
        fallen: links that were refuted before.
        settings: of the merge.
    """
    some = neighbours(sheets, changed)
    if len(some) < 2:
        return []
    inside = {pair: b for pair, b in bundles.items() if pair[0] in some and pair[1] in some}
    kept = [link for bundle in inside.values() for link in bundle.links.values()]
    labels = sorted({whole.label(node) for one in some for node in sheets[one].nodes})
    graphs = [whole.graph(label, math.inf) for label in labels]
    impossible, refutation = clashing(sheets, some, graphs, kept, fallen, settings)
    return [
        ([link for link in kept if refutation.key_of(link) == key], reason)
        for key, reason in impossible.items()
    ]
