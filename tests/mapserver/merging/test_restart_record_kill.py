"""A server that is really killed while its robots map, and goes on over the files next to its store."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SERVER = """
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


def reported_and_killed(store: Path, first: int, end: int) -> Any:
    """A server prints what it began with and what it has after some drives; then it is killed."""
    command = [sys.executable, "-c", SERVER, str(store), str(first), str(end)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        return json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_a_killed_server_supersedes_and_links_what_one_that_goes_on_does(tmp_path: Path) -> None:
    _, whole = reported_and_killed(tmp_path / "on", 0, 6)
    assert len(whole[0]) > 15 and len(whole[1]) > 20
    before: Any = None
    for first, end in ((0, 4), (4, 6), (6, 6)):
        start, after = reported_and_killed(tmp_path / "killed", first, end)
        assert before is None or start == before
        before = after
    assert before == whole
