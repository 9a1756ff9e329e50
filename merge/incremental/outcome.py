"""What a step has come to, as a merged map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId
from hybridmap.ruling import Rulings
from merge.belief.consistency import ConsistencySettings
from merge.belief.drives import refuse_drives
from merge.graph.links import RefusedLink
from merge.graph.merged import MergedMap, Postures
from merge.incremental.graph import WideGraph
from merge.incremental.ledger import Ledger
from merge.incremental.sheets import Assembly


def outcome(
    maps: Mapping[MapId, HybridMap],
    whole: Assembly,
    ledger: Ledger,
    own: Mapping[MapId, Sequence[RefusedLink]],
    consistency: ConsistencySettings,
    rulings: Rulings,
) -> MergedMap:
    """The island as a merged map.

    Args:
        maps: of the island.
        whole: the graph of all.
        ledger: says which links are believed.
        own: what was refused of each map's own claims.
        consistency: when drives are believed.
        rulings: of people.
    """
    graphs: list[WideGraph] = [whole.graph(int(label), math.inf) for label in np.unique(whole.labels)]
    graphs.sort(key=lambda graph: (-len(graph.nodes), graph.anchor))
    links = [link for bundle in ledger.bundles.values() for link in bundle.links.values()]
    refused = [r for known in ledger.refused.values() for r in known.values()]
    refused += [r for known in own.values() for r in known]
    refused += refuse_drives(maps, graphs, consistency)
    return MergedMap(
        dict(sorted(maps.items())),
        tuple(sorted(links, key=lambda link: link.pair)),
        tuple(sorted(refused, key=lambda refusal: refusal.pair)),
        tuple(frozenset(graph.rows) for graph in graphs),
        Postures(graphs),
        tuple(graphs),
        rulings,
    )
