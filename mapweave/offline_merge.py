"""Merging map files without a server: the same merge on the same bytes."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import gtsam  # noqa: F401, where it is missing this says so before a map is read

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pin import Pin
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning import Pruning
from mapweave.mapserver.merging.verification_cache import fingerprint_of
from mapweave.mapserver.merging.verification_cache_keeper import VerificationCacheKeeper
from mapweave.mapserver.own_maps import maps_of, marginal_links
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import link_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.storage.map_file import MapFile, read_map_file
from mapweave.wire.codec import encode_body

Progress = Callable[[int, int], None]
"""Called with how many of how many nodes and edges are read."""


@dataclass(frozen=True, eq=False)
class Parts:
    """What there is to merge.

    Attributes:
        maps: the robots' own, by id.
        constraints: manual constraints in any of the files.
        notes: what was left out, one sentence each.
        history: history of the maps in any of the files, in order.
        annotations: what people say about them in any of the files.
        images: of floor plans, by their names, in any of the files.
        marginals: links that are left of nodes which a server has pruned, in any of the files.
        refused_changes: maps of which a server refused a change, and why, in any of the files.
    """

    maps: dict[MapId, HybridMap]
    constraints: ManualConstraints
    notes: tuple[str, ...] = ()
    history: tuple[MapEvent, ...] = ()
    annotations: Annotations = field(default_factory=Annotations)
    images: Mapping[str, bytes] = field(default_factory=dict)
    marginals: tuple[Edge, ...] = ()
    refused_changes: Mapping[MapId, str] = field(default_factory=dict)

    def merged(
        self, settings: MergeSettings | None = None, progress: Progress = lambda done, of: None
    ) -> MergedMap:
        """All of it in one map; see `merge_parts`."""
        return merge_parts(
            self.maps, self.constraints, progress, settings, pins=self.annotations.pins,
            marginals=self.marginals, refused_changes=self.refused_changes,
        )  # fmt: skip


def parts_of(files: Mapping[Path, MapFile] | Mapping[Path | str, MapFile]) -> Parts:
    """The robots' own maps in some files, and the manual constraints in any of them.

    The same map twice is taken once. Of an older and a newer state of it the newer one counts: numbers are
    never reused, so the longer one is newer.

    Raises:
        InvalidFile: two files hold different maps of one name, or it cannot be decided which is newer.
    """
    maps: dict[MapId, HybridMap] = {}
    origin: dict[MapId, Path | str] = {}
    constraints = ManualConstraints()
    notes: list[str] = []
    ordered = sorted(files.items(), key=lambda file: str(file[0]))
    for path, content in ordered:
        if not content.changes:
            notes.append(f"there is nothing in {path}")
        for map_id, hybrid_map in sorted(maps_of(content).items()):
            if map_id in maps:
                kept, kept_path = maps[map_id], origin[map_id]
                if _length(kept) > _length(hybrid_map):
                    (kept, kept_path), (hybrid_map, path) = (hybrid_map, path), (kept, kept_path)
                if objection := _objection(kept, hybrid_map):
                    raise InvalidFile(f"map {map_id} is in {kept_path} and in {path}: {objection}")
                if _length(kept) < _length(hybrid_map):
                    notes.append(f"map {map_id} is taken from {path}, since that in {kept_path} is older")
            maps[map_id], origin[map_id] = hybrid_map, path
        constraints += ManualConstraints(content.constraints)
    events = {hybrid_map for content in files.values() for hybrid_map in content.history}
    history = sorted(events, key=lambda hybrid_map: (hybrid_map.stamp_ns, hybrid_map.kind, hybrid_map.words))
    said: Annotations = sum((Annotations(content.annotations) for content in files.values()), Annotations())
    images = {name: png for content in files.values() for name, png in content.images.items()}
    marginals = {edge.id: edge for content in files.values() for edge in marginal_links(content)}
    constraints = constraints.with_floors(said.floors)
    refused = {which: why for _, content in ordered for which, why in content.refused_changes.items()}
    return Parts(
        maps, constraints, tuple(notes), tuple(history), said, images, tuple(marginals.values()), refused
    )


def _length(hybrid_map: HybridMap) -> int:
    """How far a map has come: its greatest number."""
    return max((own.number for own in (*hybrid_map.nodes, *hybrid_map.edges)), default=0)


def _objection(older: HybridMap, newer: HybridMap) -> str:
    """Why one map is not a later state of another; empty if it is."""
    both = older.nodes.keys() & newer.nodes.keys()
    if (older.nodes and not both) or any(older.nodes[n].stamp_ns != newer.nodes[n].stamp_ns for n in both):
        return "these are two maps of one name, made at different times: leave one of them out"
    if _length(older) == _length(newer) and _bytes(older) != _bytes(newer):
        return "it cannot be decided which is newer: leave one of them out"
    return ""


def _bytes(hybrid_map: HybridMap) -> list[bytes]:
    return sorted(encode_body(change) for change in hybrid_map.contents())


def _digest(maps: Mapping[MapId, HybridMap]) -> bytes:
    """Of all nodes: the same whenever these maps are merged, and unknown to who has made but one of them."""
    digest = hashlib.blake2b(digest_size=16)
    for _, hybrid_map in sorted(maps.items()):
        for _, node in sorted(hybrid_map.nodes.items()):
            digest.update(fingerprint_of(node))
    return digest.digest()


def merge_parts(
    maps: Mapping[MapId, HybridMap],
    constraints: ManualConstraints,
    progress: Progress = lambda done, of: None,
    settings: MergeSettings | None = None,
    store: Path | None = None,
    pins: Sequence[Pin] = (),
    marginals: Iterable[Edge] = (),
    standing: Iterable[Pair] = (),
    refused_changes: Mapping[MapId, str] | None = None,
) -> MergedMap:
    """Merge robots' maps as the map server does.

    Args:
        maps: by id; they are not changed.
        constraints: manual constraints.
        progress: see `Progress`.
        settings: how they are merged.
        store: the server's store from which they come: what that server has compared is not compared again.
        pins: that hold frames, oldest first.
        marginals: links that are left of nodes which a server has pruned.
        standing: verified links that this server no longer decides again, by their nodes.
        refused_changes: maps of which a server refused a change, and why.

    Raises:
        InvalidValue: a map cannot be merged; writing the others would lose it.
    """
    merger = Merger(settings=settings, choice_key=_digest(maps))
    merger.constrain(constraints)
    merger.pin(pins)
    for map_id, reason in (refused_changes or {}).items():
        merger.note_refusal(map_id, reason)
    merger.restore_pruning(Pruning([link_of(edge) for edge in marginals], standing))
    changes = [
        (map_id, change) for map_id, hybrid_map in sorted(maps.items()) for change in hybrid_map.contents()
    ]
    if store is not None:
        VerificationCacheKeeper(store, fresh=True).restore(merger)
        merger.read(changes)
        progress(len(changes), len(changes))
        changes = []
    for k, (map_id, change) in enumerate(changes):
        merger.apply(map_id, change)
        progress(k + 1, len(changes))
    merged = merger.merged()
    for map_id, reason in merged.set_apart.items():
        raise InvalidValue(f"map {map_id} cannot be merged: {reason}; leave its file out, or retire it")
    return merged


def merge_map_files(paths: Iterable[str | PathLike[str]]) -> MapFile:
    """Merge map files as `mapweave map merge` does.

    Returns:
        The merged map, to be written with `write_map_file`. It does not depend on the order of the files.

    Raises:
        InvalidFile: a file cannot be read, or two hold different maps of one name.
        InvalidValue: a map cannot be merged, or one path is given in the place of a list.
    """
    if isinstance(paths, (str, PathLike)):
        raise InvalidValue(f"give a list of map files, such as [{str(paths)!r}], not one path")
    parts = parts_of({Path(path): read_map_file(Path(path)) for path in paths})
    merged = parts.merged()
    return map_file_of(merged, parts.history, parts.annotations, parts.images)
