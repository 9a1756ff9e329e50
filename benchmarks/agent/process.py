"""The process that is measured: an agent over a drive, with some libraries as if they were not installed.

    python -m benchmarks.agent.process DRIVE FOLDER ENDPOINT SEED [LIBRARY ...]

Nothing but the standard library is imported before the time is taken. Prints one JSON object.
"""

import json
import sys
import threading
import time
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

WARM_UP = 20
"""Ticks that do not count: the first of each kind allocates and loads."""
PERIOD = 0.04
"""s between two observations. On a robot it is 0.1 s; the threads of disk and network work in between."""


class NotInstalled:
    """A finder of modules that refuses some."""

    def __init__(self, libraries: list[str]) -> None:
        """Take their names."""
        self._libraries = set(libraries)

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Refuse them; other finders find the others."""
        if name.split(".")[0] in self._libraries:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def measure(drive: Path, folder: Path, endpoint: str, seed: int) -> dict[str, float]:
    """Run the agent, and take its times.

    Args:
        drive: see `benchmarks.agent.drive`.
        folder: for the journal and the map.
        endpoint: of a router.
        seed: of the agent.
    """
    began = time.perf_counter()
    # What `mapweave agent` imports.
    import cv2
    import numpy as np

    import mapweave.agent.drivers.checked
    import mapweave.agent.drivers.claim
    import mapweave.agent.drivers.registry  # noqa: F401 - for the time that it takes
    from mapweave.hybridmap.mission_order import MissionKind
    from mapweave.processes.agent import Agent, AgentOptions
    from mapweave.settings import Settings
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus

    import_s = time.perf_counter() - began

    from benchmarks.agent.drive import NAME, RenderedDrive
    from benchmarks.process_usage import peak_mb
    from mapweave.agent.observation import Observation

    times: list[float] = []
    cpu_times: list[float] = []
    nodes: list[int] = []

    class Timed(RenderedDrive):
        """Takes the time from an observation to the next: the whole loop but the robot itself."""

        began = cpu_began = 0.0

        def sense(self) -> Observation | None:
            if self.began:
                times.append(time.perf_counter() - self.began)
                cpu_times.append(time.thread_time() - self.cpu_began)
                nodes.append(len(agent.pipeline.map.nodes))
            observation = super().sense()
            time.sleep(max(0.0, self.began + PERIOD - time.perf_counter()))
            self.began, self.cpu_began = time.perf_counter(), time.thread_time()
            return observation

    cv2.setNumThreads(1)
    robot = Timed(drive)
    bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
    try:
        bus.wait_connected(5.0)
        options = AgentOptions(NAME, folder, epoch=1, mission=MissionKind.EXPLORE, seed=seed, patience=0.0)
        agent = Agent(robot.describe, bus, Keys("benchmark"), Settings().agent, options)
        cpu = time.process_time()
        agent.run(robot, threading.Event())
        cpu = time.process_time() - cpu
        agent.close()
    finally:
        robot.close()
        bus.close()
    cpu_ms = 1e3 * np.array(cpu_times[WARM_UP:])
    ms, node = 1e3 * np.array(times[WARM_UP:]), np.diff(nodes[WARM_UP - 1 :]) > 0
    return {
        "tick_ms_p50": float(np.percentile(ms, 50)),
        "tick_ms_p99": float(np.percentile(ms, 99)),
        "tick_ms_most": float(ms.max()),
        "tick_cpu_ms_p50": float(np.percentile(cpu_ms, 50)),
        "tick_cpu_ms_p99": float(np.percentile(cpu_ms, 99)),
        "node_ms": float(np.median(ms[node])) if node.any() else float("nan"),
        "cpu_ms_per_tick": 1e3 * cpu / len(times),
        "rss_mb": peak_mb(),
        "import_s": import_s,
        "nodes": nodes[-1],
        "ticks": len(times),
        "late_ticks": int((ms > 1e3 * robot.describe().tick).sum()),
    }


if __name__ == "__main__":
    sys.meta_path.insert(0, NotInstalled(sys.argv[5:]))
    figures: dict[str, Any] = measure(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
    print(json.dumps(figures))
