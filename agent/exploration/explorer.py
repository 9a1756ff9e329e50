"""Exploration: map each view around a place by driving back and forth, travel to the next place."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator

import numpy as np

from mapweave.agent.exploration.avoided_places import AvoidedPlaces
from mapweave.agent.exploration.behaviours import ExplorationBehaviours
from mapweave.agent.exploration.fleet_coverage import FleetCoverage
from mapweave.agent.exploration.phase import Phase
from mapweave.agent.exploration.viewpoint_selection import (
    REACH,
    SPACING,
    next_viewpoint,
    seen_around,
    views_of,
)
from mapweave.agent.mapping.episode import Episode, Move
from mapweave.agent.mission import Answer, Question
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Array

COVERED_REACH = 0.7
"""Nodes within this of a place show it, m."""
COVERED_SHARE = 0.75
"""A place around which nodes cover this share of all directions is not mapped again."""


class Explorer:
    """Drives a robot so that its mapper sees the whole reachable floor.

    Written as one generator a behaviour, so the order of actions can be read from top to bottom: each
    `yield` is a command for one tick, or a request to the mapper.

    Attributes:
        places: where it has made a full turn, (x, y) m in map.
        spacing: least distance between two of them, m.
    """

    spacing = SPACING

    def __init__(
        self,
        map_id: MapId,
        description: RobotDescription,
        mapper: Episode,
        floor: OccupancyGrid,
        settings: ExplorerSettings | None = None,
        seed: int = 0,
    ) -> None:
        """Take the robot's description, and the mapper and grid that the pipeline keeps up to date."""
        self.places: list[Array] = []
        self._description = description
        self._mapper = mapper
        self._floor = floor
        self._settings = settings or ExplorerSettings()
        self._moves = ExplorationBehaviours(description, mapper, self._settings)
        self._fleet_coverage = FleetCoverage(map_id, REACH + SPACING)
        self._rng = np.random.default_rng(seed)
        self._side = self._either_side()
        self._avoided = AvoidedPlaces(self.spacing)
        self._now = 0.0
        self._questions: list[Question] = []
        self._behaviour = self._explore()

    def see(self, observation: Observation, answers: tuple[Answer, ...] = ()) -> None:
        """Begin a tick. The mapper and the floor have seen the observation already."""
        self._moves.see(observation)
        self._now += self._description.tick
        self._questions = []
        for answer in answers:
            self._fleet_coverage.take(answer)

    def next_move(self) -> Move:
        """What to do next; a command ends the tick."""
        return next(self._behaviour)

    @property
    def questions(self) -> list[Question]:
        """For the fleet's map, of this tick."""
        return self._questions

    @property
    def phase(self) -> Phase:
        """What it is doing."""
        return self._moves.phase

    @property
    def detail(self) -> str:
        """Why, in words."""
        return self._moves.detail

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to explore."""
        return self.phase is Phase.DONE

    @property
    def idle(self) -> bool:
        """Whether it stands because there is nothing to explore now."""
        return self.phase in (Phase.DONE, Phase.WAITING)

    def restart(self) -> None:
        """Begin again from the present pose, after the robot was lost."""
        self._moves.phase, self._moves.detail = Phase.LOOKING, ""
        self._behaviour = self._explore()

    def _explore(self) -> Iterator[Move]:
        yield from self._moves.begin()
        self._ask()
        while True:
            if seen_around(self._views, self._moves.position, COVERED_REACH) >= COVERED_SHARE:
                yield from self._scan()
            else:
                yield from self._look_around()
            self.places.append(self._moves.position)
            path = yield from self._await_way_on()
            if not path:
                break
            self._ask()
            if not (yield from self._moves.travel(path)):
                self._avoided.add(path[-1], self._now)
        yield from self._stand()

    def _await_way_on(self) -> Generator[Move, None, list[Array]]:
        """Corners of the way to the next place; waits if there is none but to a place to be tried again."""
        while not (path := self._way_on()):
            until = self._avoided.next_try(self._now)
            if until is None:
                break
            self._moves.phase = Phase.WAITING
            while self._now < until:
                self._moves.detail = f"in {until - self._now:.0f} s"
                yield Command()
        return path

    def _stand(self) -> Iterator[Move]:
        """There is no place left to go."""
        self._moves.phase, self._moves.detail = Phase.DONE, ""
        while True:
            yield Command()

    def _look_around(self) -> Iterator[Move]:
        """Map view after view, turning on the spot between them, all the way around."""
        turned = 0.0
        while True:
            yield from self._moves.map_view()
            before = turned
            turned += yield from self._moves.turn_to_next_view(self._side)
            if before < math.pi <= turned:
                # The answer may take half of the turn, and is recent when the robot has to choose.
                self._ask()
            if turned > math.tau - 0.3:
                yield from self._moves.map_view()
                return

    def _scan(self) -> Iterator[Move]:
        """Turn until the rangers have swept all around: the views are mapped, the floor is unknown."""
        self._ask()
        bearings = np.sort(np.array(self._description.ranger_bearings))
        gaps = np.diff(bearings, append=bearings[:1] + math.tau)
        turned = 0.0
        while turned < (gaps.max() if len(gaps) else math.tau):
            turned += 0.05 + (yield from self._moves.turn_to_next_view(self._side, Phase.SCANNING))

    def _way_on(self) -> list[Array]:
        """Corners of the way to the next place; empty if there is none."""
        s = self._settings
        been = np.array([*self.places, *self._avoided.places(self._now)])
        fleet_places = self._fleet_coverage.places(self._views, COVERED_REACH, COVERED_SHARE)
        return next_viewpoint(self._floor, self._moves.position, been, fleet_places, s, self.spacing)

    @property
    def _views(self) -> Array:
        """(N, 4) of own and of others' nodes; see `views_of`."""
        self._mapper.finish_pending()
        return np.concatenate([views_of(self._mapper.map), self._fleet_coverage.views])

    def _ask(self) -> None:
        """Ask what others have mapped around here. Nothing waits for the answer."""
        if self._settings.ask_fleet:
            self._questions.append(self._fleet_coverage.question(self._moves.position))

    def _either_side(self) -> float:
        return 1.0 if self._rng.random() < 0.5 else -1.0
