"""A map that a server is given at its start, beside its store: robots that come join it.

It is read at each start and kept in memory alone: the store has what robots have sent, and the file stays the
one place of the rest. A robot that goes on with a map of it sends that map whole, as ever, and so replaces it
node by node.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.change import Change, ChangeBody, NodePut
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.map_event import MapEvent
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.own_maps import maps_of
from mapweave.storage.map_file import MapFile
from mapweave.wire.codec import element_of


@dataclass(frozen=True, eq=False)
class BaseMap:
    """What a map file, a store or a journal has.

    Attributes:
        name: of the file.
        maps: the robots' own maps.
        constraints: manual constraints.
        annotations: what people say about them.
        history: of these maps.
        images: of floor plans, by their names.
        refused_changes: maps of which a server refused a change, and why.
    """

    name: str = ""
    maps: Mapping[MapId, HybridMap] = field(default_factory=dict)
    constraints: ManualConstraints = field(default_factory=ManualConstraints)
    annotations: Annotations = field(default_factory=Annotations)
    history: tuple[MapEvent, ...] = ()
    images: Mapping[str, bytes] = field(default_factory=dict)
    refused_changes: Mapping[MapId, str] = field(default_factory=dict)

    @staticmethod
    def of(name: str, content: MapFile) -> BaseMap:
        """All that a file has; its links are found again, by the maps that are there then."""
        return BaseMap(
            name,
            maps_of(content),
            ManualConstraints(content.constraints),
            Annotations(content.annotations),
            content.history,
            content.images,
            content.refused_changes,
        )

    def __str__(self) -> str:
        """The map in one line, for example `office.mapweave: 120 nodes of 3 maps`."""
        nodes = sum(len(hybrid.nodes) for hybrid in self.maps.values())
        return f"{self.name}: {counted(nodes, 'node')} of {counted(len(self.maps), 'map')}"

    def beside(self, store: Store) -> BaseMap:
        """What of it counts beside a store: of a map that is in both, the newer state does.

        Numbers are never reused, so the state with the higher one is newer; the store's if they are the same.

        Raises:
            InvalidFile: another map of the same name is in the store.
        """
        known, kept = set(store.maps()), dict(self.maps)
        for map_id in sorted(known & self.maps.keys()):
            newest = 0
            for change in store.replay(map_id):
                newest = max(newest, element_of(change.body).number)
                if self.objection(change.body):
                    raise InvalidFile(
                        f"map {map_id} is in {self.name} and in the store: these are two maps of one name; "
                        "leave it out of the file, or begin with an empty store (--data)"
                    )
            mine = self.maps[map_id]
            if newest >= max((own.number for own in (*mine.nodes, *mine.edges)), default=0):
                del kept[map_id]
        return replace(self, maps=kept)

    def before(self, stored: Iterable[Change]) -> Iterator[Change]:
        """All changes at the start: those of the maps here, then those of the store's other maps."""
        for map_id, hybrid in sorted(self.maps.items()):
            for k, body in enumerate(hybrid.contents()):
                yield Change(map_id, k + 1, body.node.stamp_ns if isinstance(body, NodePut) else 0, body)
        for change in stored:
            if change.map not in self.maps:
                yield change

    def objection(self, body: ChangeBody) -> str:
        """Why a change cannot be of a map that is here; empty if it can."""
        if isinstance(body, NodePut) and body.node.id.map in self.maps:
            mine = self.maps[body.node.id.map].nodes.get(body.node.id)
            if mine is not None and mine.stamp_ns != body.node.stamp_ns:
                return f"another map goes by the name {body.node.id.map} here: begin a fresh map"
        return ""
