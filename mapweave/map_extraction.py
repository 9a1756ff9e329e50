"""Every map of an agent's journal or of a server's store, each into a map file of its own."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from mapweave.agent.replication import journal
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.node import MapId
from mapweave.mapserver.log import store
from mapweave.mapserver.log.salvage import Salvage, salvage
from mapweave.storage.map_file import MapFile, write_map_file


@dataclass(frozen=True)
class Extracted:
    """One map of a journal or store.

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


def extract_maps(source: Path, folder: Path) -> tuple[list[Extracted], str]:
    """Write every map of a journal or store into a file of a folder. The source must not be in use.

    Args:
        source: journal or store.
        folder: made if it is not there.

    Returns:
        The maps, and in one line what could not be read and belongs to no map; empty if nothing.

    Raises:
        InvalidFile: the source is neither, or cannot be read.
        InvalidValue: a file is there already; nothing was written.
    """
    maps, lost = _read(source)
    paths = {map_id: folder / f"{map_id}.mapweave" for map_id in maps}
    for path in paths.values():
        if path.exists():
            raise InvalidValue(f"{path}: is there already; choose another folder with -o")
    folder.mkdir(parents=True, exist_ok=True)
    extracted = []
    for map_id, (contents, complaint) in maps.items():
        if contents:
            write_map_file(paths[map_id], MapFile("agent", str(map_id), contents))
        nodes = sum(isinstance(body, NodePut) for body in contents)
        written = paths[map_id] if contents else None
        extracted.append(Extracted(map_id, written, nodes, len(contents) - nodes, complaint))
    return extracted, lost


def _read(source: Path) -> tuple[dict[MapId, tuple[tuple[ChangeBody, ...], str]], str]:
    """The contents of all maps with what is wrong with each, and what is wrong with the file."""
    kind = _application_id(source)
    if kind == journal.APPLICATION_ID:
        with closing(journal.Journal(source)) as of_agent:
            kept = {map_id: RetainedMap.of(of_agent, map_id) for map_id in of_agent.maps()}
        return {map_id: (extracted.contents, extracted.complaint) for map_id, extracted in kept.items()}, ""
    if kind == store.APPLICATION_ID:
        salvaged = salvage(source)
        maps = {map_id: (tuple(hybrid.contents()), "") for map_id, hybrid in sorted(salvaged.maps.items())}
        return maps, _lost(source, salvaged)
    raise InvalidFile(f"{source}: is neither an agent's journal nor a server's store")


def _lost(source: Path, salvaged: Salvage) -> str:
    """What of a store is missing in the files, in one line; empty if nothing is."""
    if salvaged.whole and not salvaged.damaged:
        return ""
    lost = f"{salvaged.damaged} damaged changes" if salvaged.damaged else "no damaged change"
    pages = (
        "" if salvaged.whole else ", and pages that cannot be read: how many changes they had is not known"
    )
    return f"{source} had {lost}{pages}"


def _application_id(source: Path) -> int:
    """What kind of SQLite file it is; 0 if unknown."""
    if not source.is_file():
        raise InvalidFile(f"{source}: no such file")
    try:
        # By SQLite itself: the last commits may be only in the file next to it.
        with closing(sqlite3.connect(source)) as connection:
            return int(connection.execute("PRAGMA application_id").fetchone()[0])
    except sqlite3.Error as error:
        reason = "is in use by another process" if "locked" in str(error) else f"cannot be read ({error})"
        raise InvalidFile(f"{source}: {reason}") from None
