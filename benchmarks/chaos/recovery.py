"""How long after a disturbance everything is acknowledged again, by the logs of the robots."""

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path

from benchmarks.chaos.schedule import Kind

NEVER = float("inf")


class RobotTimes:
    """When a robot's changes were committed and acknowledged; s of the system's monotonic clock."""

    def __init__(self, folder: Path, name: str) -> None:
        """Read its logs."""
        self.committed: list[float] = []
        self._heads: list[int] = []
        for line in (folder / f"{name}.truth").read_text().splitlines():
            match line.split():
                case ["C", _, head, at]:
                    self.committed.append(float(at))
                    self._heads.append(int(head))
        self._acks: list[tuple[float, str, int]] = []
        for line in (folder / f"{name}.acks").read_text().splitlines():
            match line.split():
                case [server, watermark, at]:
                    self._acks.append((float(at), server, int(watermark)))

    def head(self, at: float) -> int:
        """How many changes the journal had then."""
        return self._heads[k - 1] if (k := bisect_right(self.committed, at)) else 0

    def acknowledged(self, server: str, head: int, at: float, lost_at: float) -> float:
        """When, from a time on, a server had so many changes, as far as the robot knew.

        Args:
            server: which.
            head: how many.
            at: from then on.
            lost_at: acknowledgements before that are void.
        """
        mark = 0
        for time, who, watermark in self._acks:
            if who != server or time < lost_at:
                continue
            if time > at and mark >= head:
                return at
            mark = watermark
            if mark >= head and time >= at:
                return time
        return at if mark >= head else NEVER


def recoveries(
    robots: Sequence[RobotTimes], servers: Sequence[str], done: Sequence[tuple[float, Kind, str]]
) -> list[float]:
    """Times, s, from the end of each disturbance until every server has all that was committed by then.

    What else happens meanwhile counts: a second server that is killed before the first has caught up makes
    both recoveries longer.

    Args:
        robots: all of them.
        servers: all that must have everything.
        done: end, kind and target of each disturbance.
    """
    took = []
    for end, _, _ in done:
        lost = dict.fromkeys(servers, 0.0)
        for at, kind, target in done:
            if kind is Kind.LOSE_STORE and at <= end:
                lost[target] = max(lost[target], at)
        latest = max(
            robot.acknowledged(server, robot.head(end), end, lost[server])
            for robot in robots
            for server in servers
        )
        took.append(max(0.0, latest - end))
    return took
