"""A server that is really killed, and starts again from the files next to its store."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mapweave.mapserver.merging.verification_cache_keeper import SUFFIX
from tests.waiting import eventually

SERVER = """
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


def reported_and_killed(store: Path) -> dict[str, Any]:
    """A server prints its merged map; then it is killed."""
    process = subprocess.Popen([sys.executable, "-c", SERVER, str(store)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        collected: dict[str, Any] = json.loads(process.stdout.readline())
        eventually(store.with_name(store.name + SUFFIX).exists)
    finally:
        process.kill()
        process.communicate()
    return collected


@pytest.mark.slow
def test_a_server_that_is_killed_goes_on_where_it_was(tmp_path: Path) -> None:
    first = reported_and_killed(tmp_path / "store")
    second = reported_and_killed(tmp_path / "store")
    assert first["digest"] == second["digest"] and "4 maps, 1 component" in first["map"]
    assert first["verified"] > 300 and second["verified"] == 0
