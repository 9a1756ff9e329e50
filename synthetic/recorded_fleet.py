"""The fleet of `mapweave server --demo`: four robots in a made-up office, one of them in another building.

`python -m synthetic.recorded_fleet` writes it to where the command reads it. Landmarks are drawn as in
`synthetic.world`, with seeds, so the file is the same each time.
"""

import math
import shutil
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.last_shown import NOTHING, LastShown, write_shown
from mapweave.mapserver.http.reply import PATIENCE
from mapweave.mapserver.http.web import Questions
from mapweave.mapserver.merging.verification_cache_keeper import SUFFIX
from mapweave.mapserver.server import MapServer
from mapweave.recorded_fleet.fleet import RecordedFleet, prepare
from mapweave.recorded_fleet.recording import DEMO_PAGE, RECORDING, VERDICTS
from mapweave.storage.map_file import MapFile, write_map_file
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.world import Sensing, World, room, take_map

SEED = 7
SPACING = 0.8
"""Between two nodes, m."""
SENSING = Sensing(most=55, clutter=4, reach=4.5)
"""Walls hide nothing here: what is farther away than a room is not seen."""
ELSEWHERE = Pose2(4.0, -30.0, 0.4)
"""Where the other building is."""
TOURS = {
    "ada": [(1.0, 0.0), (3.0, 0.0), (3.0, 4.6), (1.2, 4.6), (1.2, 2.4), (3.0, 1.2), (5.0, 0.0), (11.0, 0.0)],
    "bo": [
        (5.0, 0.1),
        (14.8, 0.0),
        (15.0, 4.6),
        (13.2, 4.6),
        (13.2, 2.4),
        (15.0, 1.2),
        (17.0, 0.0),
        (19.0, 0.0),
    ],
    "cy": [(13.0, 0.0), (20.8, 0.1), (21.0, 4.6), (19.2, 4.6), (19.2, 2.4), (21.0, 1.2), (23.0, 0.0)],
    "dee": [(1.0, 1.0), (4.6, 1.0), (4.8, 3.4), (1.4, 3.6), (1.0, 1.4)],
}
"""Corners of each robot's way, m. The first three meet in the corridor."""


def office(rng: np.random.Generator) -> World:
    """A corridor with four rooms."""
    world = room(0.0, -1.25, 24.0, 2.5, 1100, rng)
    for x in (0.0, 6.0, 12.0, 18.0):
        world += room(x, 1.25, 6.0, 5.0, 420, rng)
    return world


def tour(corners: list[tuple[float, float]]) -> list[Pose2]:
    """Poses along a way, with turns on the spot at its corners."""
    poses: list[Pose2] = []
    for (x, y), (u, v) in pairwise(corners):
        heading, length = math.atan2(v - y, u - x), math.hypot(u - x, v - y)
        steps = max(round(length / SPACING), 1)
        shares = np.arange(steps) / steps
        poses += [Pose2(x + (u - x) * share, y + (v - y) * share, heading) for share in shares.tolist()]
    return poses


def recorded_fleet() -> list[ChangeBody]:
    """The robots' maps, one after the other, each in the order in which it was made."""
    rng = np.random.default_rng(SEED)
    main, other = office(rng), room(0.0, 0.0, 6.0, 5.0, 420, rng).moved(ELSEWHERE)
    changes: list[ChangeBody] = []
    for name, corners in TOURS.items():
        way = tour(corners)
        world = other if name == "dee" else main
        if name == "dee":
            way = [ELSEWHERE @ pose for pose in way]
        nodes, edges = take_map(world, MapId(name, 1), way, rng, SENSING)
        changes.append(NodePut(nodes[0]))
        for node, edge in zip(nodes[1:], edges, strict=True):
            changes += [NodePut(node), EdgePut(edge)]
    return changes


def page() -> LastShown:
    """What a map server shows of the recording once it has merged it, and its robots have set out."""
    with TemporaryDirectory() as path, closing(MemoryBus(MemoryHub())) as bus:
        folder, keys = Path(path), Keys("demo")
        prepare(folder, folder / "store", NOTHING)
        with MapServer(bus, keys, folder / "store", "s0") as server:
            live, end = Questions(server, PATIENCE).live, time.monotonic() + 60.0
            server.settle(60.0)
            with RecordedFleet(bus, keys, "s0", folder):
                while sum(robot.merged_from_robot is not None for robot in server.robots().robots) < len(
                    TOURS
                ):
                    if time.monotonic() > end:
                        raise TimeoutError("the robots are not on the merged map")
                    time.sleep(0.01)
                live.look()
                live.rate()
                return live.shown()


def verdicts() -> Path:
    """Write what a map server finds by comparing the nodes of the recording."""
    VERDICTS.unlink(missing_ok=True)
    with TemporaryDirectory() as path, closing(MemoryBus(MemoryHub())) as bus:
        store = Path(path) / "store"
        prepare(store.parent, store, NOTHING)
        with MapServer(bus, Keys("demo"), store, "s0") as server:
            server.settle(60.0)
        shutil.copyfile(store.with_name(store.name + SUFFIX), VERDICTS)
    return VERDICTS


if __name__ == "__main__":
    write_map_file(
        RECORDING, MapFile("agent", "the fleet of mapweave server --demo", tuple(recorded_fleet()))
    )
    verdicts()
    write_shown(DEMO_PAGE, page())
    for path in (RECORDING, DEMO_PAGE, VERDICTS):
        print(f"{path}: {path.stat().st_size} bytes")
