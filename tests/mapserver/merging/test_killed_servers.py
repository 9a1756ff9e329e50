"""Servers that are really killed, and go on over the files next to their stores."""

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from mapweave.mapserver.merging.verification_cache_keeper import SUFFIX
from tests.waiting import eventually

MAPPING = """
import json, sys, time
from dataclasses import replace
from pathlib import Path
import numpy as np
from synthetic.maps import LOG_ID, changes_of, numbered
from synthetic.world import room, take_map
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.mapserver.server import MapServer
from mapweave.wire.codec import encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Mark
from mapweave.wire.memory import MemoryBus, MemoryHub

path, first, end = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
DAY_NS = 86_400_000_000_000
rng = np.random.default_rng(1)
world, drives = room(0, 0, 5, 4, 600, rng), []
for day in range(3):
    for robot in range(2):
        map_id, stamp_ns = MapId(f"r{robot}", day + 1), (2 * day + robot + 1) * DAY_NS // 2
        around = rng.normal(0.0, [0.4, 0.3, 0.2], (5, 3))
        tour = [Pose2(2.4 + x, 2.0 + y, 0.9 * k + turn) for k, (x, y, turn) in enumerate(around)]
        nodes, edges = take_map(world, map_id, tour, rng)
        nodes = [replace(node, stamp_ns=stamp_ns + node.stamp_ns) for node in nodes]
        drives.append(numbered(map_id, changes_of(nodes, edges), stamp_ns=stamp_ns))
hub, keys = MemoryHub(), Keys()
robot = MemoryBus(hub)
with MapServer(MemoryBus(hub), keys, path, "s0", schedule=LockstepSchedule()) as server:
    assert server.settle(120)
    start = server._worker.answers.merged
    for drive in drives[first:end]:
        for change in drive:
            robot.publish(
                keys.change(change.map), encode_change(change), Mark(change.sequence, LOG_ID).encode()
            )
        # A merge for each drive, however quick the machine is.
        while server._worker.unmerged(change.map.agent) < len(drive):
            time.sleep(0.01)
        assert server.settle(120)

    def decided(merged):
        superseded = {str(node): str(one.by) for node, one in merged.superseded.items()}
        return [superseded, [[str(node) for node in link.pair] for link in merged.links]]

    print(json.dumps([decided(start), decided(server._worker.answers.merged)]), flush=True)
    time.sleep(600)
"""
"""Prints what it began with and what it has after some drives."""
STARTING = """
import hashlib, json, sys, time
from pathlib import Path
import pytest
import numpy as np
from synthetic.maps import map_tours, write_store
from synthetic.world import room
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

path = Path(sys.argv[1])
if not path.exists():
    rng = np.random.default_rng(3)
    world = room(0, 0, 5, 4, 500, rng) + room(5, 0, 5, 4, 700, rng) + room(10, 0, 5, 4, 500, rng)
    rooms = {"a": (0, 5), "b": (5, 10), "c": (0, 10), "d": (0, 5)}
    tours = {
        MapId(agent, 1): [Pose2(x + 2.2 + 0.1 * k, 1.8, 0.6 * k) for x in seen for k in range(6)]
        for agent, seen in rooms.items()
    }
    write_store(path, map_tours(world, tours, rng))
with MapServer(MemoryBus(MemoryHub()), Keys(), path, "s0") as server:
    began = time.thread_time()
    assert server.settle(120)
    merger, merged = server._worker._merger, server._worker.answers.merged
    digest = hashlib.sha256(repr([
        [link.pair for link in merged.links], [(r.pair, r.reason) for r in merged.refused],
    ]).encode())
    for node, place in merged.poses.items():
        digest.update(place.merged_from_robot.mean.vector.tobytes())
        digest.update(place.merged_from_robot.covariance.tobytes())
    report = {"digest": digest.hexdigest(), "verified": merger.counters.verified, "map": merged.summary()}
    print(json.dumps(report), flush=True)
    time.sleep(600)
"""
"""Prints its merged map."""


def reported_and_killed(program: str, *arguments: object, until: Callable[[], object] = lambda: True) -> Any:
    """What a server prints; then it is killed, once something holds."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        said = json.loads(process.stdout.readline())
        eventually(until)
        return said
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_a_killed_server_supersedes_and_links_what_one_that_goes_on_does(tmp_path):
    _, whole = reported_and_killed(MAPPING, tmp_path / "on", 0, 6)
    assert len(whole[0]) > 15 and len(whole[1]) > 20
    before: Any = None
    for first, end in ((0, 4), (4, 6), (6, 6)):
        start, after = reported_and_killed(MAPPING, tmp_path / "killed", first, end)
        assert before is None or start == before
        before = after
    assert before == whole


@pytest.mark.slow
def test_a_server_that_is_killed_goes_on_where_it_was(tmp_path):
    store = tmp_path / "store"
    cache = store.with_name(store.name + SUFFIX)
    first, second = (reported_and_killed(STARTING, store, until=cache.exists) for _ in range(2))
    assert first["digest"] == second["digest"] and "4 maps, 1 component" in first["map"]
    assert first["verified"] > 300 and second["verified"] == 0
