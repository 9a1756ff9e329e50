"""The robots that the server hears of: their last status, whether they are alive, where they are."""

import hashlib
import math
import threading
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from mapweave.hybridmap.agent_status import (
    LONGEST_STATUS_PERIOD,
    MAX_ACCUSATION,
    MAX_ROBOTS,
    MOST_AHEAD,
    NO_COMPONENT,
    AgentStatus,
    FleetStatus,
    RobotEntry,
    one_line,
)
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_POSITION
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.log.known_logs import Lag
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.quotas import MOST_ROBOTS, Quotas
from mapweave.merge.explanation.map_standing import MapStanding, map_standings
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.bus import Bus, BusClient, Sample
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode

OWN_PERIOD = 0.5
"""Between two statuses of a robot that is not asked for fewer, s."""
STATUSES_PER_S = 400.0
"""Of all robots that a server wants: up to 200 robots each as it likes, of a thousand one every 2.5 s."""
STAGGER = 1 / 3
"""By up to this share a robot reports more or less often than the others: those that begin together report
apart after two periods, instead of all at the same time as long as they run."""
REMINDERS_PER_S = 50.0
"""At most: a fleet that begins at once is reminded one robot after the other."""
MOST_ALIVE = 8
"""Maps under which a robot is alive at once: it makes one, and two while it begins the next."""
NO_LAG = Lag(0, 0.0)
UNKNOWN = MapStanding(None, 0, "")
"""Of a map that is not merged yet."""


class Presence(NamedTuple):
    """What is known of a robot without looking at the map.

    Attributes:
        alive: whether its agent is there.
        age: since its last status, s; None if none has come.
        unsent: changes that no server has acknowledged, by its own count.
    """

    alive: bool
    age: float | None
    unsent: int


class Roster(BusClient):
    """Listens until closed. Thread-safe.

    Attributes:
        remind: acknowledges the log of a map once more.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        clock: Callable[[], float],
        hear: Callable[[AgentStatus], None],
        quotas: Quotas,
        lags: Callable[[], Mapping[str, Lag]] = dict,
    ) -> None:
        """Begin to listen.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            clock: only grows, s.
            hear: called with each status.
            quotas: of robots.
            lags: how far the store is behind each of them.
        """
        self._lags = lags
        self._standings: tuple[MergedMap, Mapping[MapId, MapStanding]] = MergedMap.empty(), {}
        self._quotas = quotas
        self._keys, self._clock, self._hear = keys, clock, hear
        self._turn = threading.Lock()
        self._alive: dict[str, set[MapId]] = {}
        self._heard: dict[str, tuple[AgentStatus, float]] = {}
        self._reminded: dict[str, float] = {}
        self._next_reminder = -math.inf
        self.remind: Callable[[MapId], None] = lambda map_id: None
        self._closing = [
            bus.subscribe(keys.agent_statuses(), self._take),
            bus.watch(keys.agents_alive(), self._see),
        ]

    def alive(self, robot: str) -> bool:
        """Whether an agent of this name is there."""
        with self._turn:
            return bool(self._alive.get(robot))

    def status(self, robot: str) -> AgentStatus | None:
        """The last status of a robot; None if none has come."""
        with self._turn:
            return self._heard[robot][0] if robot in self._heard else None

    def map_of(self, robot: str) -> MapId | None:
        """The map that a robot makes: the newest under which it is alive, or that of its last status."""
        with self._turn:
            if alive := self._alive.get(robot):
                return max(alive)
            return MapId(robot, self._heard[robot][0].epoch) if robot in self._heard else None

    def status_period(self) -> float:
        """How much time between two statuses of a robot there should be, s; 0: as they like, 0.5 s.

        Statuses of a thousand robots, twice a second, take the server a fifth of a core.
        """
        with self._turn:
            period = len(self._alive) / STATUSES_PER_S
        return min(period, LONGEST_STATUS_PERIOD) if period > OWN_PERIOD else 0.0

    def status_period_of(self, robot: str) -> float:
        """The same for one robot: how it differs depends on its name alone, so that servers agree."""
        drawn = int.from_bytes(hashlib.blake2b(robot.encode(), digest_size=4).digest(), "big")
        share = 2.0 * drawn / 2**32 - 1.0
        return min(self.status_period() / (1.0 + STAGGER * share), LONGEST_STATUS_PERIOD)

    def _reports_too_often(self, robot: str, since: float, now: float) -> bool:
        """Whether a robot has to be reminded of its period, with the time since its last status, s.

        It hears it with acknowledgements alone, and is acknowledged nothing where it makes no node: of 1000
        robots that drive in a building that they know each sent two statuses a second.
        """
        if since >= 0.5 * self.status_period_of(robot):
            return False
        with self._turn:
            # So that one that does not listen keeps no other from it, and an answer has time to come.
            again = self._reminded.get(robot, -math.inf) + LONGEST_STATUS_PERIOD
            if robot not in self._heard or now < max(again, self._next_reminder):
                return False
            self._reminded[robot], self._next_reminder = now, now + 1.0 / REMINDERS_PER_S
        return True

    def presence(self) -> Mapping[str, Presence]:
        """All robots that are heard of, by name: `MAX_ROBOTS` at most."""
        now = self._clock()
        with self._turn:
            known = {name for name, maps in self._alive.items() if maps} | self._heard.keys()
            found = {}
            for name in sorted(known)[:MAX_ROBOTS]:
                status, at = self._heard.get(name, (None, now))
                age, unsent = (None, 0) if status is None else (max(now - at, 0.0), status.unsent)
                found[name] = Presence(bool(self._alive.get(name)), age, unsent)
        return found

    def robots(
        self, places: PlaceResolver, ways: Mapping[str, tuple[NodeId, ...]] = MappingProxyType({})
    ) -> FleetStatus:
        """All robots, with where they are in a merged map.

        Args:
            places: of the map.
            ways: the nodes ahead of robots that drive.
        """
        merged = places.merged
        now = self._clock()
        with self._turn:
            known = {name for name, maps in self._alive.items() if maps} | self._heard.keys()
            heard, alive = dict(self._heard), {name for name, maps in self._alive.items() if maps}
        over, lags, standings = self._quotas.over(), self._lags(), self._standings_in(merged)
        newest_maps = {map_id.agent: map_id for map_id in standings}
        against: dict[str, str] = {}
        for map_id, words in sorted(merged.accusations().items()):
            against[map_id.agent] = words[:MAX_ACCUSATION]
        entries = []
        for name in sorted(known | over.keys())[:MAX_ROBOTS]:
            status, at = heard.get(name, (None, now))
            pose, component = (None, NO_COMPONENT) if status is None else whereabouts(status, merged)
            place, floor = "", ""
            if pose is not None:
                place, floor = places.name_at(component, pose), places.floor_of(component)
            age = max(now - at, 0.0)
            words, accusation = one_line(over.get(name, "")), against.get(name, "")
            own = newest_maps.get(name) if status is None else status.map
            newest, links, apart = standings.get(own, UNKNOWN) if own is not None else UNKNOWN
            missing, lag = lags.get(name, NO_LAG)
            entries.append(
                RobotEntry(
                    name, name in alive, age, status, pose, component, place, floor, words, accusation,
                    missing, lag, newest, links, one_line(apart), ways.get(name, ())[:MOST_AHEAD],
                )
            )  # fmt: skip
        return FleetStatus(tuple(entries))

    def _standings_in(self, merged: MergedMap) -> Mapping[MapId, MapStanding]:
        """The standings of a merged map's maps, worked out once."""
        known, standings = self._standings
        if known is not merged:
            standings = map_standings(merged)
            self._standings = merged, standings
        return standings

    def _take(self, sample: Sample) -> None:
        robot = self._keys.parse_agent_status(sample.key)
        status = decode(sample.payload, AgentStatus)
        named = {status.robot or robot, robot if status.mission is None else status.mission.order.robot}
        if named != {robot}:
            raise InvalidMessage(f"a status of {robot} is about {' and '.join(sorted(named - {robot}))}")
        now = self._clock()
        with self._turn:
            _, before = self._heard.get(robot, (status, -math.inf))
            if robot in self._heard or len(self._heard) < MAX_ROBOTS:
                self._heard[robot] = status, now
        if self._reports_too_often(robot, now - before, now):
            self.remind(status.map)
        self._hear(status)

    def _see(self, key: str, alive: bool) -> None:
        map_id = self._keys.parse_agent_alive(key)
        with self._turn:
            maps = self._alive.get(map_id.agent, set())
            full = len(maps) >= MOST_ALIVE or (not maps and len(self._alive) >= MOST_ROBOTS)
            if not alive:
                maps.discard(map_id)
            elif not full:
                maps.add(map_id)
            if maps:
                self._alive[map_id.agent] = maps
            else:
                self._alive.pop(map_id.agent, None)
        if alive and full:
            self._quotas.hold_back(map_id.agent, "liveliness tokens")
        elif alive:
            # Until then it reports rarely.
            self.remind(map_id)


def whereabouts(status: AgentStatus, merged: MergedMap) -> tuple[Pose2 | None, int]:
    """`merged_from_robot` and its component; None if the robot, or its map, is not placed."""
    reported = status.status
    if reported.fix_node is not None:
        node, node_from_robot = reported.fix_node, reported.node_from_robot
    elif reported.located and (nearest := _nearest(status.map, reported.map_from_robot, merged)) is not None:
        node, node_from_robot = nearest
    else:
        return None, NO_COMPONENT
    component = merged.component_of(node)
    if component is None or node not in merged.poses:
        return None, NO_COMPONENT
    pose = merged.pose(node) @ node_from_robot
    if max(abs(pose.x), abs(pose.y)) > MAX_POSITION:
        # No message holds it, and the message is about all robots.
        return None, NO_COMPONENT
    return pose, component


def _nearest(map_id: MapId, map_from_robot: Pose2, merged: MergedMap) -> tuple[NodeId, Pose2] | None:
    """The nearest node of the robot's own map that has a merged pose, and the robot's pose from there."""
    own = merged.maps.get(map_id)
    placed = [] if own is None else [node for node in own.nodes.values() if node.id in merged.poses]
    if not placed:
        return None
    near = min(placed, key=lambda node: map_from_robot.distance(node.map_from_robot.mean))
    return near.id, near.map_from_robot.mean.inverse() @ map_from_robot
