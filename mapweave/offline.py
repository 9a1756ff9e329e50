"""Merging map files without a server: the same merge on the same bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from hybridmap.errors import InvalidFile
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId
from hybridmap.ruling import Rulings
from mapserver.mapfiles import maps_of
from mapserver.merging.merger import Merger, MergerSettings
from merge.graph.merged import MergedMap
from merge.merging import MergeSettings
from wire.mapfile import MapFile

Progress = Callable[[int, int], None]
"""Told how many of how many nodes and edges are taken in."""


def parts_of(files: Mapping[Path, MapFile]) -> tuple[dict[MapId, HybridMap], Rulings]:
    """The robots' own maps in some files, and all that people have ruled in any of them.

    Raises:
        InvalidFile: two files hold the same map.
    """
    maps: dict[MapId, HybridMap] = {}
    origin: dict[MapId, Path] = {}
    rulings = Rulings()
    for path, content in files.items():
        for map_id, one in maps_of(content).items():
            if map_id in maps:
                raise InvalidFile(f"{path}: map {map_id} is in {origin[map_id]} too: leave one of them out")
            maps[map_id], origin[map_id] = one, path
        rulings += Rulings(content.rulings)
    return maps, rulings


def merge_parts(
    maps: Mapping[MapId, HybridMap],
    rulings: Rulings,
    progress: Progress = lambda done, of: None,
    settings: MergeSettings | None = None,
) -> MergedMap:
    """Merge robots' maps as the map server does.

    Args:
        maps: by id; they are not changed.
        rulings: of people.
        progress: told how far it is.
        settings: how they are merged.
    """
    merger = Merger(settings=MergerSettings(merging=settings or MergeSettings()))
    merger.rule(rulings)
    bodies = [(map_id, body) for map_id, one in sorted(maps.items()) for body in one.contents()]
    for k, (map_id, body) in enumerate(bodies):
        merger.apply(map_id, body)
        progress(k + 1, len(bodies))
    return merger.merged()
