"""A map that is opened: a map file, a server's store or an agent's journal. Opening never changes it.

What a file is shows its content, not its name: map files and SQLite files have their own first bytes, and
stores and journals their own application ids.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from mapweave.agent.replication import journal
from mapweave.agent.replication.salvage import salvage as salvage_journal
from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage
from mapweave.hybridmap.ids import MapId, NodeId, read_number
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.mapserver.log import sqlite_store
from mapweave.mapserver.log.opening import is_postgres
from mapweave.mapserver.log.salvage import Salvage, all_of, salvage
from mapweave.mapserver.log.store import HISTORY, PRUNING
from mapweave.mapserver.own_maps import maps_of, marginal_links
from mapweave.mapserver.plan_images import kept_images, recorded_images
from mapweave.storage.atomic_file import State, state_of, unchanged_since
from mapweave.storage.database_reader import MAGIC as SQLITE
from mapweave.storage.database_reader import cut_off, is_without_log, reading
from mapweave.storage.file_format import of_format
from mapweave.storage.map_file import MAGIC, MapFile, read_map_file, write_map_file
from mapweave.storage.os_errors import unreadable
from mapweave.wire.messages import KeptHistory, KeptPruning, decode

if TYPE_CHECKING:
    from mapweave.merge.pose_graph.merged_map import MergedMap
    from mapweave.merge.settings import MergeSettings

Value = TypeVar("Value")
UNREAD = "pages that cannot be read: how many changes they had is not known"
NO_LOG = "holds no map yet: what was written is in {}, beside it where it was made; copy both"
OTHER = "is neither a map file nor an agent's journal nor a server's store"


class MapSource(StrEnum):
    """What a map is in, in words."""

    FILE = "map file"
    STORE = "server's store"
    JOURNAL = "agent's journal"

    @property
    def words(self) -> str:
        """The kind of map with its article."""
        return f"{'an' if self is MapSource.JOURNAL else 'a'} {self.value}"


@dataclass(frozen=True, eq=False)
class OpenedMap:
    """A map file, store or journal, as it was when it was opened.

    Attributes:
        path: of the file; the address of a PostgreSQL database, without secrets.
        source: what it is.
        content: of a file as it is; of a store or journal all maps, constraints, annotations and history, not
            merged yet.
        maps: the robots' maps in it, also those of a journal that are empty.
        complaints: what of each map could not be read, in one line each; key None: what belongs to no map.
        standing: verified links that a store's server no longer decides again, by their nodes.
        state: of a map file, when it was read.
    """

    path: Path | str
    source: MapSource
    content: MapFile
    maps: tuple[MapId, ...]
    complaints: Mapping[MapId | None, str]
    standing: frozenset[tuple[NodeId, NodeId]] = frozenset()
    state: State | None = None

    @property
    def name(self) -> str:
        """The name for people: that of the file, without its folder."""
        return self.path.name if isinstance(self.path, Path) else self.path

    @cached_property
    def decided(self) -> bool:
        """Whether there is nothing to merge: a file was merged, and a single map needs it for constraints."""
        return self.source is MapSource.FILE or (
            len(maps_of(self.content)) < 2 and not ManualConstraints(self.content.constraints).in_force
        )

    def merged(
        self,
        settings: MergeSettings | None = None,
        progress: Callable[[int, int], None] = lambda done, of: None,
    ) -> MergedMap:
        """The merged map.

        Of a file as it was decided when it was written, and of a single robot's map with its own loop
        closures applied; several maps of a store or journal are merged as a server merges them.

        Raises:
            InvalidFile: the measurements determine no poses.
            InvalidValue: a map cannot be merged.
        """
        # This loads the libraries that solve pose graphs: what only looks into a map does without.
        from mapweave.mapserver.map_files import merged_of

        if self.decided:
            return merged_of(self.content, settings)
        return self.merged_again(settings, progress)

    def merged_again(
        self,
        settings: MergeSettings | None = None,
        progress: Callable[[int, int], None] = lambda done, of: None,
    ) -> MergedMap:
        """The robots' maps merged as a server merges them, also those of a file.

        Raises:
            InvalidValue: a map cannot be merged.
        """
        from mapweave.offline_merge import merge_parts

        maps = maps_of(self.content)
        floors = Annotations(self.content.annotations).floors
        constraints = ManualConstraints(self.content.constraints, floors=floors)
        of_store = self.path if self.source is MapSource.STORE and isinstance(self.path, Path) else None
        pins = Annotations(self.content.annotations).pins
        marginals = marginal_links(self.content)
        return merge_parts(
            maps, constraints, progress, settings, of_store, pins, marginals, self.standing,
            self.content.refused_changes,
        )  # fmt: skip

    def file(self, merged: MergedMap) -> MapFile:
        """The content of a map file that holds the whole map, as `merged` returned it."""
        if self.decided:
            return self.content
        from mapweave.mapserver.map_files import map_file_of

        said = Annotations(self.content.annotations)
        return map_file_of(merged, self.content.history, said, self.content.images)

    def written(self, out: Path, content: MapFile) -> OpenedMap:
        """This, once a map file that was made of it is written; over its own if that is as it was.

        Raises:
            InvalidFile: another process has written its own file since; or the disk does not take it.
        """
        if self.source is MapSource.FILE and out.exists() and out.samefile(self.path):
            with unchanged_since(out, self.state):
                write_map_file(out, content)
                return replace(self, state=state_of(out))
        write_map_file(out, content)
        return self


def open_map(path: Path | str) -> OpenedMap:
    """Open a map file, a server's store or an agent's journal, whatever its name. Nothing is written.

    Args:
        path: of a file, or the address of a PostgreSQL database with a server's store, which may be in use.

    Raises:
        InvalidFile: it is none of these, damaged, truncated, of another version, or in use by a process.
    """
    if isinstance(path, str) and is_postgres(path):
        return _of_postgres(path)
    path = Path(path)
    source = source_of(path)
    if source is MapSource.FILE:
        state, content = state_of(path), read_map_file(path)
        return OpenedMap(path, source, content, tuple(sorted(maps_of(content))), {}, state=state)
    return _of_journal(path) if source is MapSource.JOURNAL else _of_store(path)


def _not_yet(path: Path) -> str:
    """Where the map of an agent is whose file, for example `r0.1.mapweave`, is not written yet."""
    name = path.name.removesuffix(".mapweave")
    robot, _, number = name.partition(".")
    kept = path.with_name(f"{robot}.sqlite")
    if name == path.name or read_number(number) is None or not kept.exists():
        return ""
    return (
        f" yet: the agent of {robot} writes it when it ends; while it runs ask the server, `mapweave map "
        f"fetch FILE`, and after it was killed take it from the journal, `mapweave map extract {kept}`"
    )


def source_of(path: Path, live: bool = False) -> MapSource:
    """What a file is, by its content.

    Args:
        path: of the file.
        live: a running agent or server may use it.

    Raises:
        InvalidFile: it is no map, cannot be read, or is of a newer version.
    """
    if path.is_dir():
        raise InvalidFile(f"{path}: is a folder; give a map file, or a server's or agent's .sqlite in it")
    if not path.exists():
        raise InvalidFile(f"{path}: no such file{_not_yet(path)}")
    if not path.is_file():
        raise InvalidFile(f"{path}: cannot be read (not a regular file)")
    try:
        with path.open("rb") as file:
            head = file.read(len(SQLITE))
    except OSError as error:
        raise unreadable(path, error) from None
    if head and head.startswith(MAGIC[: len(head)]):
        return MapSource.FILE
    if head != SQLITE:
        raise InvalidFile(f"{path}: {OTHER}")
    try:
        with reading(path, live=live) as connection:
            kind, version = (
                int(connection.execute(f"PRAGMA {name}").fetchone()[0])
                for name in ("application_id", "user_version")
            )
    except sqlite3.Error as error:
        raise InvalidFile(f"{path}: cannot be read ({cut_off(path) or error})") from None
    if not kind and is_without_log(path):
        log = path.with_name(path.name + "-wal")
        raise InvalidFile(f"{path}: {NO_LOG.format(log.name)}")
    if kind == journal.APPLICATION_ID:
        if version != journal.VERSION:
            raise InvalidFile(f"{path}: agent journal {of_format(version, journal.VERSION)}")
        return MapSource.JOURNAL
    if kind != sqlite_store.APPLICATION_ID:
        raise InvalidFile(f"{path}: {OTHER}")
    if version != sqlite_store.VERSION:
        raise InvalidFile(f"{path}: map store {of_format(version, sqlite_store.VERSION)}")
    return MapSource.STORE


def _of_journal(path: Path) -> OpenedMap:
    salvaged = salvage_journal(path)
    kept = salvaged.maps
    changes = tuple(body for retained in kept.values() for body in retained.contents)
    complaints: dict[MapId | None, str] = {m: one.complaint for m, one in kept.items() if one.complaint}
    if not salvaged.whole:
        complaints[None] = f"{path} had {_unread(path)}"
    return OpenedMap(
        path, MapSource.JOURNAL, MapFile("agent", _title(kept), changes), tuple(kept), complaints
    )


def _of_store(path: Path) -> OpenedMap:
    return _of_salvaged(path, salvage(path), lambda annotations: kept_images(path, annotations))


def _of_postgres(address: str) -> OpenedMap:
    # Without the extra `postgres` there is no psycopg.
    from mapweave.mapserver.log.postgres_store import PostgresStore

    with closing(PostgresStore(address, "reader", read_only=True)) as store:
        return _of_salvaged(store.address.words, all_of(store), partial(recorded_images, store))


def _of_salvaged(
    path: Path | str, salvaged: Salvage, images: Callable[[Annotations], dict[str, bytes]]
) -> OpenedMap:
    constraints, bad = _read(salvaged.constraints, ManualConstraint)
    history, worse = _read([salvaged.results[HISTORY]] if HISTORY in salvaged.results else [], KeptHistory)
    annotations, worst = _read(salvaged.annotations, Annotation)
    pruning, wrong = _read([salvaged.results[PRUNING]] if PRUNING in salvaged.results else [], KeptPruning)
    bodies = [body for _, hybrid in sorted(salvaged.maps.items()) for body in hybrid.contents()]
    for kept in pruning:
        # These load the libraries that solve pose graphs.
        from mapweave.mapserver.merging.pruning import marginal_of

        bodies += [EdgePut(marginal_of(link).edge()) for link in kept.links]
    content = MapFile(
        "agent",
        _title(salvaged.maps),
        tuple(bodies),
        constraints=tuple(constraints),
        history=tuple(event for record in history for event in record.events),
        annotations=tuple(annotations),
        images=images(Annotations(tuple(annotations))),
        refused_changes=salvaged.refused_changes,
    )
    complaint = _lost(path, salvaged, bad + worse + worst + wrong)
    maps = tuple(sorted(salvaged.maps))
    standing = frozenset(pair for kept in pruning for pair in kept.standing)
    return OpenedMap(path, MapSource.STORE, content, maps, {None: complaint} if complaint else {}, standing)


def _unread(path: Path | str) -> str:
    """What of a damaged file could not be read, in words."""
    cut = cut_off(path) if isinstance(path, Path) else ""
    return f"{UNREAD}; the file is {cut}" if cut else UNREAD


def _title(maps: Collection[MapId]) -> str:
    return str(*maps) if len(maps) == 1 else f"{len(maps)} maps"


def _read(bodies: Iterable[bytes], kind: type[Value]) -> tuple[list[Value], int]:
    """The values, and how many could not be read."""
    values, bad = [], 0
    for body in bodies:
        try:
            values.append(decode(body, kind))
        except InvalidMessage:
            bad += 1
    return values, bad


def _lost(path: Path | str, salvaged: Salvage, unread: int) -> str:
    """What of a store could not be read, in one line; empty if all could."""
    lost = salvaged.damaged + unread
    if salvaged.whole and not lost:
        return ""
    damaged = counted(lost, "damaged change") if lost else "no damaged change"
    pages = "" if salvaged.whole else f", and {_unread(path)}"
    return f"{path} had {damaged}{pages}"
