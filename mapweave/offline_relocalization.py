"""Where an image was taken, by a map file alone: no server, no network."""

import faiss  # noqa: F401, where it is missing this says so before a map is read

from mapweave.mapserver.active_nodes import ActiveNodes
from mapweave.mapserver.map_files import merged_of
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.map_file import MapFile


def relocalizer_of(content: MapFile) -> Relocalizer:
    """A relocalizer that answers from a map file as a map server answers from its store.

    Args:
        content: a robot's own map or a merged one. Nodes that are superseded, retired or faded count as such.

    Raises:
        InvalidFile: the file's measurements determine no poses.
    """
    return relocalizer_in(merged_of(content))


def relocalizer_in(merged: MergedMap) -> Relocalizer:
    """A relocalizer that answers from a merged map; see `relocalizer_of`."""
    nodes = {node.id: node for one in merged.maps.values() for node in one.nodes.values()}
    places = PlaceDatabase()
    places.put(nodes.values())
    active = ActiveNodes(places, nodes.get, merged)
    return Relocalizer(active, active.node, merged)
