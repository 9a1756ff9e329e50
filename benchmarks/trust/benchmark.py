"""A map server that lies to a lost robot: what does the robot do, and does it arrive when the lies end?

    python -m benchmarks.trust [--seed N] [--lies NAME ...] [--lying S] [--json]

A robot without a map stands somewhere in a simulated office and is sent to a node. Its whole agent asks a
test double behind its bus, which answers with one lie after the other (a drive each). Lies last until the
robot has given up its goal, says that it has arrived, or `--lying` seconds are over; then the double tells
the truth, and a robot that has given up is sent again. Judged by the simulator's truth: touches, the least
clearance, the way driven while it was lied to, and whether it arrives in the end. `bound_m` is what the agent
promises of the way.
"""

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.command_line import command_line, failing_in_one_line
from benchmarks.trust.building import MappedBuilding, mapped_office
from benchmarks.trust.lying_server import LIES, LyingServer
from mapweave.agent.navigation.answer_trial import LONGEST_ROUTE, MORE_WAY, ROUTES
from mapweave.agent.observation import Command
from mapweave.agent.settings import AgentSettings
from mapweave.agent.synchronization import LockstepWaiting
from mapweave.fleet import send_order
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.hybridmap.pose import Pose2
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

ROBOT = "r1"
CLOSE = 0.1
"""Within this of where the goal's image was taken a robot has arrived, m."""
HONEST = 240.0
"""s that it has for this once the answers are true."""
APART = (2.0, 5.0)
"""Least and largest distance of start and goal, m."""


@dataclass(frozen=True)
class TrustOutcome:
    """One drive.

    Attributes:
        lie: its name.
        touches: of anything, in the whole drive.
        clearance_m: least true clearance of the footprint.
        way_m: driven while it was lied to.
        lied_s: how long that was.
        said: by the robot at the end of that.
        gave_up: whether it had given up by then.
        false_arrival: whether it said that it had arrived, and had not.
        arrived: whether it arrived once the answers were true.
        honest_s: how long that took.
    """

    lie: str
    touches: int
    clearance_m: float
    way_m: float
    lied_s: float
    said: str
    gave_up: bool
    false_arrival: bool
    arrived: bool
    honest_s: float


class TrustDrive:
    """One robot, lost, and its server."""

    def __init__(self, building: MappedBuilding, start: Pose2, goal: NodeId, seed: int, folder: Path) -> None:
        """Put the robot down."""
        self._building, self._goal = building, goal
        hub = MemoryHub()
        self._buses = [MemoryBus(hub) for _ in range(3)]
        keys = Keys("trust")
        self.simulation = Simulation(building.world, [RobotSetup(ROBOT)], seed, [start])
        self.server = LyingServer(
            self._buses[0], keys, building.map, building.truth, lambda: self.simulation.truth(ROBOT), seed
        )
        self.server.goal = goal
        options = AgentOptions(
            ROBOT, folder, epoch=1, mission=MissionKind.STOP, seed=seed, synchronization=LockstepWaiting(),
            patience=0.0,
        )  # fmt: skip
        self.agent = Agent(
            lambda: self.simulation.describe(ROBOT), self._buses[1], keys, AgentSettings(), options
        )
        self._keys = keys
        self._command = Command()
        self.clearance = np.inf
        self.way = 0.0

    def go(self) -> None:
        """Send it to its goal."""
        send_order(
            self._buses[2], self._keys, MissionOrder.new(ROBOT, MissionKind.GO, "benchmark", self._goal)
        )

    def tick(self) -> None:
        """One tick of world, robot and server."""
        before = self.simulation.truth(ROBOT)
        self.simulation.advance({ROBOT: self._command})
        here = self.simulation.truth(ROBOT)
        self.way += before.distance(here)
        free = self._building.world.plan.clearances(np.array([[here.x, here.y]]))[0]
        self.clearance = min(self.clearance, float(free) - self.simulation.describe(ROBOT).radius)
        self.step = self.agent.tick(self.simulation.observe(ROBOT))
        self._command = self.step.command
        if self.agent.runner.has_questions:
            self.agent.runner.exchange()

    @property
    def off(self) -> float:
        """How far it is from its goal, m."""
        return self.simulation.truth(ROBOT).distance(self._building.truth[self._goal])

    def close(self) -> None:
        """End it."""
        self.agent.close()
        for bus in self._buses:
            bus.close()
        self.simulation.close()


def drive(building: MappedBuilding, name: str, seed: int, lying: float) -> TrustOutcome:
    """One drive with one lie."""
    rng = np.random.default_rng([seed, sorted(LIES).index(name), 0xD21])
    start, goal = plot(building, rng)
    with tempfile.TemporaryDirectory() as folder:
        one = TrustDrive(building, start, goal, seed, Path(folder))
        try:
            one.server.lie = LIES[name]()
            one.go()
            ticks = 0
            while ticks < lying * 10:
                one.tick()
                ticks += 1
                if one.step.status.given_up or one.step.status.finished:
                    break
            status, way, lied_s = one.step.status, one.way, ticks / 10
            false_arrival = status.finished and one.off > CLOSE
            said = f"{status.doing}: {status.detail}"
            one.server.lie = None
            if status.given_up or false_arrival:
                one.go()
                one.tick()
            ticks = 0
            while ticks < HONEST * 10 and not (one.step.status.finished and one.off <= CLOSE):
                one.tick()
                ticks += 1
                if one.step.status.given_up:
                    break
            arrived = one.step.status.finished and one.off <= CLOSE
            return TrustOutcome(
                name, one.simulation.collisions(ROBOT), round(one.clearance, 3), round(way, 1), lied_s,
                said, status.given_up, false_arrival, arrived, ticks / 10,
            )  # fmt: skip
        finally:
            one.close()


def plot(building: MappedBuilding, rng: np.random.Generator) -> tuple[Pose2, NodeId]:
    """Where from and where to: a free pose, and a node that a route leads to."""
    plan = building.world.plan
    joined = sorted(building.truth)
    while True:
        start = plan.random_free_pose(rng, 0.3)
        goal = joined[int(rng.integers(len(joined)))]
        if APART[0] <= start.distance(building.truth[goal]) <= APART[1]:
            return start, goal


def summary(outcomes: list[TrustOutcome]) -> dict[str, object]:
    """The figures of all drives."""
    return {
        "drives": len(outcomes),
        "touches": sum(one.touches for one in outcomes),
        "least_clearance_m": min(one.clearance_m for one in outcomes),
        "most_way_m": max(one.way_m for one in outcomes),
        "bound_m": MORE_WAY + ROUTES * LONGEST_ROUTE,
        "false_arrivals": sum(one.false_arrival for one in outcomes),
        "gave_up": sum(one.gave_up for one in outcomes),
        "arrived_by_the_truth": sum(one.arrived for one in outcomes),
    }


def main() -> None:
    """Lie, drive and print."""
    parser = command_line("trust", __doc__, "of office, starts, goals and lies")
    parser.add_argument("--rooms", type=int, default=1, help="of the office (default 1)")
    parser.add_argument("--lies", nargs="*", choices=list(LIES), default=list(LIES), help="default all")
    parser.add_argument(
        "--lying", type=float, default=330.0, help="lies last so long, simulated s (default 330)"
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    console = Console(stderr=arguments.json, width=180)
    if not arguments.lying > 0.0:
        parser.error("--lying must be longer than 0 s")
    with failing_in_one_line("trust"):
        building = mapped_office(arguments.seed, arguments.rooms)
        outcomes = []
        for name in arguments.lies:
            outcomes.append(drive(building, name, arguments.seed, arguments.lying))
            console.print(outcomes[-1])
    console.print(_table(outcomes, arguments.seed))
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, **summary(outcomes)}))


def _table(outcomes: list[TrustOutcome], seed: int) -> Table:
    """A drive a row."""
    table = Table(title=f"seed {seed}")
    for name in ("lie", "touches", "clearance m", "way m", "lied s", "arrived by the truth", "s", "it said"):
        table.add_column(name)
    for one in outcomes:
        table.add_row(
            one.lie, str(one.touches), f"{one.clearance_m:.2f}", f"{one.way_m:.1f}", f"{one.lied_s:.0f}",
            "yes" if one.arrived else "no", f"{one.honest_s:.0f}", one.said,
        )  # fmt: skip
    return table
