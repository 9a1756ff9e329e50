"""Robots' maps of synthetic worlds as changes, as a server's store, and as merged maps."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.merging.merger import Merger
from mapweave.wire.codec import encode_change
from synthetic.world import World, room, take_map

LOG_ID = 7
"""Of every log in a store that is written here."""


def looking_around(stops: int) -> list[Pose2]:
    """A tour nearly on the spot, in the middle of a room of 5 m x 4 m."""
    return [Pose2(2.4 + 0.05 * k, 2.0, 0.7 * k) for k in range(stops)]


def changes_of(nodes: Iterable[Node], edges: Iterable[Edge]) -> list[ChangeBody]:
    """The changes that put them into a map: nodes first."""
    return [*map(NodePut, nodes), *map(EdgePut, edges)]


def map_tours(
    world: World,
    tours: Mapping[MapId, Sequence[Pose2]],
    rng: np.random.Generator,
    sigma_xy: float = 0.03,
    sigma_heading: float = 0.02,
) -> dict[MapId, list[ChangeBody]]:
    """The changes of robots that map one world, each on its tour; see `synthetic.world.take_map`."""
    return {
        map_id: changes_of(*take_map(world, map_id, list(tour), rng, None, sigma_xy, sigma_heading))
        for map_id, tour in tours.items()
    }


def looked_around(maps: Iterable[MapId], seed: int, stops: int = 4) -> dict[MapId, list[ChangeBody]]:
    """The changes of robots that each look around in one room, all drawn with a seed."""
    rng = np.random.default_rng(seed)
    return map_tours(room(0, 0, 5, 4, 700, rng), dict.fromkeys(maps, looking_around(stops)), rng)


def merger_of(logs: Mapping[MapId, Iterable[ChangeBody]]) -> Merger:
    """A merger that has taken in all changes, map by map."""
    merger = Merger()
    for map_id, changes in logs.items():
        for change in changes:
            merger.apply(map_id, change)
    return merger


def numbered(map_id: MapId, changes: Iterable[ChangeBody], first: int = 1, stamp_ns: int = 0) -> list[Change]:
    """The changes as a robot's log has them, numbered from `first`, all of one time."""
    return [Change(map_id, number, stamp_ns, body) for number, body in enumerate(changes, first)]


def entries_of(map_id: MapId, changes: Iterable[ChangeBody], first: int = 1) -> list[ReceivedChange]:
    """The changes as they come over the wire, numbered from `first`."""
    log = numbered(map_id, changes, first)
    return [ReceivedChange.read(map_id, change.sequence, encode_change(change)) for change in log]


def fill_store(store: Store, logs: Mapping[MapId, Iterable[ChangeBody]]) -> None:
    """Have a store take in all changes, each map's as a whole log."""
    for map_id, changes in logs.items():
        entries = entries_of(map_id, changes)
        store.apply(map_id, LOG_ID, entries, len(entries))


def write_store(path: Path, logs: Mapping[MapId, Iterable[ChangeBody]]) -> Path:
    """A server's store at `path`, which has all changes and is closed."""
    store = SqliteStore(path)
    fill_store(store, logs)
    store.close()
    return path
