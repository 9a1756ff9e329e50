"""Keys of the simulator; `wire` has those of robots and servers."""

from dataclasses import dataclass

from mapweave.hybridmap.ids import check_name
from mapweave.wire.keys import Keys


@dataclass(frozen=True)
class SimKeys(Keys):
    """The keys of one fleet and of the simulator that it lives in."""

    def control(self) -> str:
        """Where the simulator takes commands (kidnap, truth, stop)."""
        return f"{self.root}/sim/ground_truth_client"

    def sim_alive(self) -> str:
        """Under which the simulator is alive."""
        return f"{self.root}/sim/alive"

    def rendezvous(self, robot: str) -> str:
        """Where a robot's agent waits until every robot has finished the tick."""
        return f"{self.root}/sim/rendezvous/{check_name(robot)}"
