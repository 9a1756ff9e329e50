"""Exploration: map each view around a place by driving back and forth, travel to the next place."""

import math
from collections.abc import Generator, Iterator

import numpy as np

from mapweave.agent.exploration.avoided_places import AvoidedPlaces
from mapweave.agent.exploration.behaviours import ExplorationBehaviours, Phase
from mapweave.agent.exploration.fleet_coverage import FleetCoverage
from mapweave.agent.exploration.viewpoint_selection import (
    REACH,
    SPACING,
    next_viewpoint,
    seen_around,
    views_of,
)
from mapweave.agent.mapping.episode import Move
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mapping.relative_poses import relative_poses, way_lengths
from mapweave.agent.mission import Question, ServerAnswer
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.settings import ExplorerSettings
from mapweave.agent.submap_grid import SubmapGrid
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array, Pose2

COVERED_REACH = 0.7
"""Nodes within this of a place show it, m."""
COVERED_SHARE = 0.75
"""A place around which nodes cover this share of all directions is not mapped again."""
LOOP = 10.0
"""A way over the map's edges that is this much longer than over the floor is a loop worth closing, m."""


class Explorer:
    """Drives a robot so that its mapper sees the whole reachable floor.

    Written as one generator a behaviour, so the order of actions can be read from top to bottom: each
    `yield` is a command for one tick, or a request to the mapper.

    Attributes:
        spacing: least distance between two places at which it makes a full turn, m.
    """

    spacing = SPACING

    def __init__(
        self,
        map_id: MapId,
        description: RobotDescription,
        mapper: Mapper,
        floor: OccupancyGrid,
        settings: ExplorerSettings | None = None,
        seed: int = 0,
    ) -> None:
        """Take the robot's description, and the mapper and grid that the pipeline keeps up to date."""
        self._places: list[tuple[NodeId | None, Array]] = []
        self._map_from_node: dict[NodeId, Pose2] = {}
        self._loops_tried: list[Array] = []
        self._closes_loop = False
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

    def see(self, observation: Observation, answers: tuple[ServerAnswer, ...] = ()) -> None:
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
        """Questions of this tick for the fleet's map."""
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
        # Found again, the robot is where an earlier node says.
        self._correct_drift()
        self._ask()
        while True:
            covered = seen_around(self._views, self._moves.position, COVERED_REACH) >= COVERED_SHARE
            if covered and not self._closes_loop:
                yield from self._scan()
            else:
                yield from self._look_around()
            self._places.append((self._mapper.last, self._moves.position))
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
        self._correct_drift()
        s = self._settings
        been = np.array([*self._been(), *self._avoided.places(self._now)])
        here, nodes = self._moves.position, self._own_views[:, :2]
        others = self._fleet_coverage.places(self._views, COVERED_REACH, COVERED_SHARE)
        path = next_viewpoint(self._floor, here, been, nodes, others, s, self.spacing)
        self._closes_loop = not path
        return path or self._way_to_close_a_loop()

    def _way_to_close_a_loop(self) -> list[Array]:
        """Corners of the way to a node that is near over the floor and far over edges; empty without one.

        The robot has come back to where it was, and no node shows it (Stachniss, Haehnel, Burgard:
        Exploration with active loop-closing for FastSLAM, IROS 2004). Each part of the floor is tried once.
        """
        here = self._mapper.last
        if here is None:
            return []
        lengths = way_lengths(self._mapper.map, here)
        ways = self._floor.ways(self._moves.position, math.inf)
        numbers = np.full(self._floor.room().shape, -1)
        numbers[ways.cells[:, 0], ways.cells[:, 1]] = np.arange(len(ways.cells))
        best, gained = None, LOOP
        for node, place in zip(self._mapper.map.nodes, self._own_views[:, :2], strict=True):
            k = int(numbers[tuple(self._floor.cells(place))])
            tried = any(math.dist(place, before) < REACH for before in self._loops_tried)
            if k >= 0 and not tried and lengths.get(node, 0.0) - ways.lengths[k] > gained:
                best, gained = k, lengths[node] - ways.lengths[k]
        if best is None:
            return []
        self._loops_tried.append(ways.positions[best])
        return ways.path(ways.cells[best])

    def _correct_drift(self) -> None:
        """Let what was seen and where it has been lie as loop closures say, as seen from here."""
        self._mapper.finish_pending()
        last, own_map = self._mapper.last, self._mapper.map
        if last is None or not isinstance(self._floor, SubmapGrid):
            return
        here = own_map.nodes[last].map_from_robot.mean
        poses = {node: here @ pose for node, pose in relative_poses(own_map, last).items()}
        if self._floor.correct(poses):
            self._map_from_node = poses

    def _been(self) -> Iterator[Array]:
        """(2,) m in map, where it has made a full turn."""
        nodes = self._mapper.map.nodes
        for node, position in self._places:
            if node in nodes and node in self._map_from_node:
                way = nodes[node].map_from_robot.mean
                yield self._map_from_node[node].apply(way.inverse().apply(position))
            else:
                yield position

    @property
    def _views(self) -> Array:
        """(N, 4) of own and of others' nodes; see `views_of`."""
        return np.concatenate([self._own_views, self._fleet_coverage.views])

    @property
    def _own_views(self) -> Array:
        """The same of own nodes."""
        self._mapper.finish_pending()
        return views_of(self._mapper.map, self._map_from_node)

    def _ask(self) -> None:
        """Ask what others have mapped around here. Nothing waits for the answer."""
        if self._settings.ask_fleet:
            self._questions.append(self._fleet_coverage.question(self._moves.position))

    def _either_side(self) -> float:
        return 1.0 if self._rng.random() < 0.5 else -1.0
