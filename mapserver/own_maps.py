"""The robots' own maps in a map file."""

from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.explanation import MARGINAL
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MERGE_AUTHOR, MapId
from mapweave.hybridmap.node import Edge
from mapweave.storage.map_file import MapFile
from mapweave.wire.codec import element_of

PROBABILITY = "probability"
"""Name among the evidence of a link in a file: see mapweave.merge.outlier_rejection.link_probability."""


def maps_of(content: MapFile) -> dict[MapId, HybridMap]:
    """The robots' own maps in a file, with what was refused of their edges; links are not theirs."""
    maps: dict[MapId, HybridMap] = {}
    refused = (EdgePut(r.edge) for r in content.refused if r.edge is not None)
    for change in (*content.changes, *refused):
        element = element_of(change)
        if not (isinstance(change, EdgePut) and is_link(change.edge)):
            maps.setdefault(element.map, HybridMap()).apply(change)
    return maps


def marginal_links(content: MapFile) -> tuple[Edge, ...]:
    """The links in a file that are left of nodes which a server has pruned."""
    edges = (change.edge for change in content.changes if isinstance(change, EdgePut))
    return tuple(edge for edge in edges if is_link(edge) and MARGINAL in edge.evidence)


def is_link(edge: Edge) -> bool:
    """Whether the merge made an edge, and not a robot."""
    return edge.id.map == MapId(MERGE_AUTHOR, 0)
