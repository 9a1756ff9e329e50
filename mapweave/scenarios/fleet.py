"""What a trial needs of a fleet, whether its robots live in one process or in many."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mapweave.agent.settings import AgentSettings
from mapweave.scenarios.scenario import Scenario
from mapweave.sim.ground_truth_client import SimControl
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

FLEET = "trial"
SERVER = "s0"
FIRST_EPOCH = 1
TICKS_PER_SECOND = 10


@dataclass(frozen=True)
class TrialStage:
    """Where a trial takes place.

    Attributes:
        scenario: what is tried.
        seed: of everything.
        out: folder: `agents/` holds journals and map files, `server/` the store, `logs/` the output.
        settings: of every robot's pipeline.
        settings_file: where they came from, if from a file.
        rerun: whether each robot's agent writes a log for the Rerun viewer.
        mcap_log: whether it writes one for Foxglove.
    """

    scenario: Scenario
    seed: int
    out: Path
    settings: AgentSettings
    settings_file: Path | None = None
    rerun: bool = False
    mcap_log: bool = False

    @property
    def robots(self) -> tuple[str, ...]:
        """Names."""
        return tuple(setup.name for setup in self.scenario.robots)

    @property
    def agents(self) -> Path:
        """Folder of journals and map files."""
        return self.out / "agents"

    @property
    def store(self) -> Path:
        """The server's store."""
        return self.out / "server" / f"{SERVER}.sqlite"

    def rerun_log(self, robot: str) -> str | None:
        """File of a robot's log, `r0.1.rrd`; `r0.2.rrd` when its agent is started again."""
        return _next(self.out / "rerun", robot, ".rrd") if self.rerun else None

    def mcap_folder(self, robot: str) -> str | None:
        """Folder of a robot's log for Foxglove, `r0.1`; `r0.2` when its agent is started again."""
        return _next(self.out / "mcap", robot) if self.mcap_log else None

    def agent_seed(self, robot: str) -> int:
        """The seed of a robot's random choices."""
        return self.seed * 16 + self.robots.index(robot)


def _next(folder: Path, robot: str, suffix: str = "") -> str:
    """The place of a robot's log at the next start of its agent."""
    starts = len(list(folder.glob(f"{robot}.*{suffix}")))
    return str(folder / f"{robot}.{starts + 1}{suffix}")


class TrialFleet(Protocol):
    """Server, simulator and agents, in lock-step. Time passes only in `advance`."""

    @property
    def bus(self) -> Bus:
        """The runner's own connection to the fleet's network."""

    @property
    def keys(self) -> Keys:
        """The keys of the fleet."""

    @property
    def control(self) -> SimControl:
        """Truth and intervention."""

    def start(self) -> None:
        """Start everything; returns when every robot is there."""

    def advance(self, tick: int) -> None:
        """Let time pass until a tick is over and every agent has finished with it.

        Raises:
            MapweaveError: a process died unexpectedly.
        """

    def kill_agent(self, robot: str) -> None:
        """End an agent at once; its robot stops."""

    def start_agent(self, robot: str) -> None:
        """Start an agent with the disk that is there; returns when its robot is driven again."""

    def kill_server(self) -> None:
        """End the map server, and the router in it, at once."""

    def start_server(self) -> None:
        """Start the map server with the disk that is there."""

    def cut(self, robot: str) -> None:
        """Take a robot's network away."""

    def worsen(self, robot: str, loss: float, delay: float) -> None:
        """Make a robot's network bad."""

    def restore(self, robot: str) -> None:
        """Give a robot its network back, as good as new."""

    def end(self) -> None:
        """End everything in order; journals and store are then closed. Idempotent."""

    def wall(self) -> dict[str, float]:
        """Wall time by part, s, where it is known."""
