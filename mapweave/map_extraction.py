"""Every robot's own map of a map file, journal or store, each into a map file of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.own_maps import maps_of
from mapweave.opened_map import open_map
from mapweave.storage.map_file import MapFile, write_map_file


@dataclass(frozen=True)
class Extracted:
    """One robot's own map.

    Attributes:
        map: which.
        path: of its file; None if it has nothing that could be written.
        nodes: in the file.
        edges: in the file.
        complaint: what could not be read, in one line; empty if all could.
    """

    map: MapId
    path: Path | None
    nodes: int
    edges: int
    complaint: str


def extract_maps(source: Path | str, folder: Path) -> tuple[list[Extracted], str, str]:
    """Write every robot's own map into a file of a folder. A journal or store must not be in use.

    Args:
        source: map file, journal or store, also one in PostgreSQL.
        folder: made if it is not there.

    Returns:
        The maps; in one line what could not be read and belongs to no map, empty if nothing; and the source
        in words, without user and password.

    Raises:
        InvalidFile: the source is none of these, or cannot be read.
        InvalidValue: a file is there already; nothing was written.
    """
    opened = open_map(source)
    maps = maps_of(opened.content)
    paths = {map_id: folder / f"{map_id}.mapweave" for map_id in opened.maps}
    for path in paths.values():
        if path.exists():
            raise InvalidValue(f"{path}: is there already; choose another folder with -o")
    folder.mkdir(parents=True, exist_ok=True)
    extracted = []
    for map_id in opened.maps:
        hybrid = maps.get(map_id, HybridMap())
        written = paths[map_id] if hybrid.nodes or hybrid.edges else None
        if written is not None:
            refused = {m: why for m, why in opened.content.refused_changes.items() if m == map_id}
            content = MapFile("agent", str(map_id), tuple(hybrid.contents()), refused_changes=refused)
            write_map_file(written, content)
        complaint = opened.complaints.get(map_id, "")
        extracted.append(Extracted(map_id, written, len(hybrid.nodes), len(hybrid.edges), complaint))
    return extracted, opened.complaints.get(None, ""), str(opened.path)
