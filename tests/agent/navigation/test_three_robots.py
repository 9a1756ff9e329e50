"""Three robots want the same narrow edge at once: one drives, two wait and say so, then the next."""

from collections.abc import Sequence

import pytest

from mapweave.agent.navigation.navigator import NavigationStage
from mapweave.mapserver.nearby import Nearby
from mapweave.mapserver.reservations import Reservations
from mapweave.mapserver.routes import Router
from synthetic.world import World
from tests.agent.reserving_robot import reserving_robot
from tests.agent.scripted_fleet import BODY, Trial
from tests.mapserver.test_reservations import node, router  # noqa: F401 - a fixture
from tests.quick import first_quick

EDGE = {node(4), node(5)}
"""In the corridor; node 9 is in a niche beside its one end."""
LONGEST = 150.0
"""s; one robot alone takes 20 s."""


class Corridor:
    """Robots with the real navigator and the real reservations, by exact wheels."""

    def __init__(self, home: World, map_router: Router, ways: Sequence[tuple[int, int]]) -> None:
        self._router, self._reservations = map_router, Reservations(Nearby().standing)
        self._home, self._ticks = home, 0
        self.goals = {f"r{k}": map_router.roads.poses[node(goal)] for k, (_, goal) in enumerate(ways)}
        self.robots = {f"r{k}": self._robot(f"r{k}", *way) for k, way in enumerate(ways)}
        self.arrived: list[str] = []
        self.gone: set[str] = set()
        self.waited: set[str] = set()
        self.least_gap = 1e9

    def _robot(self, name: str, start: int, goal: int) -> Trial:
        poses, ends = self._router.roads.poses, (node(start), node(goal))
        return reserving_robot(
            self._home, self._router, self._reservations, name, *ends, lambda: self._ticks * BODY.tick,
            facing=0.0 if poses[ends[1]].x >= poses[ends[0]].x else 3.1415,
        )  # fmt: skip

    def on_edge(self) -> set[str]:
        """Robots amid the edge."""
        low, high = sorted(self._router.roads.poses[one].x for one in EDGE)
        found = {name: trial.eyes.pose for name, trial in self.robots.items()}
        return {name for name, p in found.items() if low + 0.2 < p.x < high - 0.2 and abs(p.y) < 0.5}

    def yielding(self) -> set[str]:
        """Robots that say that they wait for another one."""
        return {name for name, one in self.robots.items() if one.navigator.stage is NavigationStage.YIELDING}

    def tick(self) -> None:
        """One tick of all who are there."""
        self._ticks += 1
        for name, trial in self.robots.items():
            if name in self.gone:
                continue
            trial.run(BODY.tick)
            if name not in self.arrived and trial.eyes.pose.distance(self.goals[name]) < 0.3:
                self.arrived.append(name)
        self.waited |= self.yielding()
        poses = [trial.eyes.pose for trial in self.robots.values()]
        gaps = [a.distance(b) for k, a in enumerate(poses) for b in poses[:k]]
        self.least_gap = min(self.least_gap, *gaps)
        assert len(self.on_edge()) <= 1, "one at a time"

    def until_all_are_there(self) -> float:
        """Returns how long it took, s."""
        while {*self.arrived} | self.gone != {*self.robots}:
            self.tick()
            assert self._ticks * BODY.tick < LONGEST, {
                name: (trial.navigator.stage, trial.navigator.detail) for name, trial in self.robots.items()
            }
        return self._ticks * BODY.tick


ONE_WAY = [(3, 8), (9, 7), (2, 6)]
"""All to the right: from before the edge, from the niche, from farther behind."""
AGAINST_TWO = [(3, 8), (6, 0), (7, 1)]
"""One to the right, two against it."""
AGAINST_ONE = [(3, 7), (2, 6), (6, 9)]
"""Two to the right, one towards them and into the niche."""


@pytest.mark.parametrize("ways", first_quick([AGAINST_TWO, ONE_WAY, AGAINST_ONE], 2))
def test_one_drives_and_two_wait_and_say_so_then_the_next(home, router, ways):  # noqa: F811
    corridor = Corridor(home, router, ways)
    corridor.until_all_are_there()
    assert len(corridor.waited) >= 2, "two waited for another one, and said so"
    assert corridor.least_gap > 2 * BODY.radius, "they have not touched"


@pytest.mark.slow
def test_two_against_one_end_although_the_first_has_taken_the_niche(home, router):  # noqa: F811
    """The first makes way for the one that comes, and the second drives up: the niche is taken then, and
    these two waited head-on for ever. Here robots do not see those that have parked, so only the edge counts.
    """
    corridor = Corridor(home, router, [(3, 8), (2, 7), (6, 0)])
    assert corridor.until_all_are_there() < LONGEST


@pytest.mark.parametrize("ways", [ONE_WAY])
@pytest.mark.parametrize("dies", ["r1", "r2"])
def test_a_waiting_robot_that_dies_holds_up_no_other(home, router, ways, dies):  # noqa: F811
    corridor = Corridor(home, router, ways)
    while dies not in corridor.yielding():
        corridor.tick()
    # Its process is gone: it stands where it is and asks no more.
    corridor.gone.add(dies)
    corridor.until_all_are_there()
    assert {*corridor.arrived} == {*corridor.robots} - {dies}
    assert corridor.least_gap > 2 * BODY.radius
