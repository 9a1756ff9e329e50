"""What is done to a fleet, and when: drawn with a seed, so that a run can be looked at again."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

LEAST_KILLS = 20


class Kind(StrEnum):
    """What a disturbance does."""

    KILL = "kill -9"
    """Started again when it ends."""
    LOSE_STORE = "kill -9, and its store is deleted"
    STOP = "SIGSTOP"
    CUT = "links cut"
    SLOW = "links slow"
    FROZEN = "links frozen"
    """Nothing comes through, and no end learns of it."""
    FLAP = "links cut again and again"
    HALF = "links half closed"
    LOSSY = "links lossy"
    """A share of TCP's segments is lost: stalls, and little throughput."""
    DISORDER = "messages doubled and late"
    """What it has published comes twice, late and in another order."""


KILLS = (Kind.KILL, Kind.LOSE_STORE)
LINKS = (
    Kind.CUT,
    Kind.SLOW,
    Kind.FROZEN,
    Kind.FLAP,
    Kind.HALF,
    Kind.LOSSY,
)
LASTING = {
    Kind.KILL: (0.1, 1.5), Kind.LOSE_STORE: (0.1, 1.5), Kind.STOP: (0.5, 7.0), Kind.CUT: (0.2, 3.0),
    Kind.SLOW: (1.0, 4.0), Kind.FROZEN: (0.5, 7.0), Kind.FLAP: (1.0, 4.0), Kind.HALF: (0.1, 0.5),
    Kind.LOSSY: (2.0, 7.0), Kind.DISORDER: (2.0, 7.0),
}  # fmt: skip
"""Shortest and longest time between beginning and end, s. The lease of a connection is 5 s."""


@dataclass(frozen=True)
class Disturbance:
    """One disturbance: what is disturbed, how and when.

    Attributes:
        at: s from the start.
        lasts: s.
        kind: what is done.
        target: to which process, or to whose links.
    """

    at: float
    lasts: float
    kind: Kind
    target: str

    def __str__(self) -> str:
        """One line for people."""
        return f"{self.at:5.1f} s  {self.target:<3} {self.kind} for {self.lasts:.1f} s"


def draw_schedule(
    seconds: float, groups: Sequence[Sequence[str]], seed: int, stores_can_be_lost: bool
) -> list[Disturbance]:
    """Disturbances spread over the time; kills make up half of them.

    A process is not killed while it is down. Two of a kind of process may well be down at once.

    Args:
        seconds: of mapping.
        groups: names of processes: agents, servers, routers, and others that are only killed.
        seed: of the draw.
        stores_can_be_lost: whether a server's store is deleted, too.
    """
    rng = np.random.default_rng([seed, 77])
    kills = max(LEAST_KILLS, round(seconds / 3.0))
    agents, servers, routers, *_ = groups
    # Each kind of process gets its share of the kills, in any order.
    victims = [groups[k % len(groups)] for k in range(kills)]
    kinds = [Kind.KILL] * kills
    if stores_can_be_lost:
        for k in [k for k, group in enumerate(victims) if group is servers][1::3]:
            kinds[k] = Kind.LOSE_STORE
    for k in range(kills // 3):
        kinds.append(Kind.STOP)
        victims.append((agents, servers, routers)[k % 3])
    for k in range(kills * 2 // 3):
        kinds.append(LINKS[k % len(LINKS)])
        # Each kind meets agents and servers.
        victims.append((agents, agents, servers)[(k + k // len(LINKS)) % 3])
    for k in range(kills // 3):
        kinds.append(Kind.DISORDER)
        victims.append((agents, agents, servers)[k % 3])
    order = rng.permutation(len(kinds))
    slot = seconds / len(kinds)
    free = dict.fromkeys((name for group in groups for name in group), 0.0)
    out: list[Disturbance] = []
    for k, index in enumerate(order):
        kind, at = kinds[index], (k + rng.uniform(0.0, 0.9)) * slot
        lasts = float(rng.uniform(*LASTING[kind]))
        # Who is free, else who is free first.
        ready = [name for name in victims[index] if free[name] <= at]
        target = str(rng.choice(ready)) if ready else min(victims[index], key=lambda name: free[name])
        at = max(at, free[target])
        free[target] = at + lasts + 1.0
        out.append(Disturbance(round(at, 2), round(lasts, 2), kind, target))
    return sorted(out, key=lambda one: one.at)
