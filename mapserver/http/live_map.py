"""The merged map as columns of numbers for viewers: as a whole, or what has changed since a version."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.mapserver.http.row_table import RowTable
from mapweave.mapserver.http.serving import json_bytes
from mapweave.merge.floors import labels_of
from mapweave.merge.pose_graph.merged_map import MergedMap

NODE_COLUMNS = (
    ("map", "<u4"), ("number", "<f8"), ("x", "<f4"), ("y", "<f4"), ("heading", "<f4"), ("component", "<u4"),
    ("state", "u1"),
)  # fmt: skip
"""`map` is an index, `number` is exact up to 2^53, x and y are m, `heading` rad, in the component's frame."""
IN_USE, SUPERSEDED = 1, 2
"""States of a node; 0 is none."""
EDGE_COLUMNS = (("a", "<u4"), ("b", "<u4"), ("kind", "u1"), ("probability", "<f4"))
"""`a` and `b` are rows of nodes, `kind` an index, 0 is none; `probability` is NaN until it is known."""
KINDS = ("", *map(str, EdgeKind))
DECIMALS = 3
"""Poses are rounded to mm and mrad: what an optimisation moves less is not sent again."""

Pair = tuple[NodeId, NodeId]


class LiveMap:
    """The newest merged map. One thread changes it while no other reads.

    Attributes:
        version: counts the changes; 0 before the first.
    """

    def __init__(self) -> None:
        """Begin with an empty map."""
        self.version = 0
        self._nodes, self._edges = RowTable(NODE_COLUMNS), RowTable(EDGE_COLUMNS)
        self._maps: dict[tuple[str, int], int] = {}
        self._merged = MergedMap.empty()
        self._components: list[dict[str, Any]] = []
        self._whole: tuple[int, str] = (-1, "")

    def show(
        self, merged: MergedMap, probabilities: Mapping[Pair, float], floors: Mapping[MapId, str]
    ) -> None:
        """Hold a merged map.

        Args:
            merged: the map.
            probabilities: of its links, as far as they are known.
            floors: labels of maps.
        """
        self._merged = merged
        version = self.version + 1
        changed = self._show_nodes(merged, version)
        changed |= self._show_edges(merged, probabilities, version)
        components = [
            {
                "anchor": str(graph.anchor),
                "nodes": len(graph.nodes),
                "maps": sorted(map(str, graph.maps)),
                "floor": " and ".join(labels_of(merged, floors, number)),
            }
            for number, graph in enumerate(merged.graphs)
        ]
        if changed or components != self._components or not self.version:
            self._components, self.version = components, version

    def message(self, since: int) -> str:
        """What a viewer that has some version lacks, JSON; all of it for a viewer that has none (0)."""
        if since == 0 and self._whole[0] == self.version:
            return self._whole[1]
        content = {
            "kind": "map", "version": self.version, "whole": since == 0,
            "maps": [f"{agent}.{epoch}" for agent, epoch in self._maps], "kinds": KINDS,
            "components": self._components, "nodes": self._nodes.columns(since),
            "edges": self._edges.columns(since),
        }  # fmt: skip
        text = json_bytes(content).decode()
        if since == 0:
            self._whole = self.version, text
        return text

    def _show_nodes(self, merged: MergedMap, version: int) -> bool:
        keys = [node for graph in merged.graphs for node in graph.nodes]
        rows = np.zeros(len(keys), list(NODE_COLUMNS))
        rows["map"] = [self._maps.setdefault(key[:2], len(self._maps)) for key in keys]
        rows["number"] = [key.number for key in keys]
        rows["state"] = [SUPERSEDED if key in merged.superseded else IN_USE for key in keys]
        if keys:
            means = np.concatenate([graph.means for graph in merged.graphs]).round(DECIMALS)
            rows["x"], rows["y"], rows["heading"] = means.T
            counts = [len(graph.nodes) for graph in merged.graphs]
            rows["component"] = np.repeat(np.arange(len(counts)), counts)
        return self._nodes.replace(keys, rows, version)

    def _show_edges(self, merged: MergedMap, probabilities: Mapping[Pair, float], version: int) -> bool:
        slots, number = self._nodes.slots, {kind: KINDS.index(kind) for kind in KINDS}
        refused = {refusal.edge for refusal in merged.refused}
        found: dict[Any, tuple[int, int, int, float]] = {}
        for hybrid_map in merged.maps.values():
            for edge in hybrid_map.edges.values():
                if edge.id not in refused and edge.a in slots and edge.b in slots:
                    found[edge.id] = slots[edge.a], slots[edge.b], number[edge.kind], np.nan
        for link in merged.links:
            if link.a in slots and link.b in slots:
                kind = number[EdgeKind.LOOP if link.within else EdgeKind.MERGED]
                found[link.key] = slots[link.a], slots[link.b], kind, probabilities.get(link.pair, np.nan)
        rows = np.array(list(found.values()), list(EDGE_COLUMNS))
        return self._edges.replace(list(found), rows, version)
