"""What the page showed last: kept beside the store, and shown while the next server loads and merges."""

import json
import logging
import zlib
from base64 import b64decode
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.json_values import json_values
from mapweave.mapserver.http.live_map import NODE_COLUMNS
from mapweave.mapserver.http.serving import json_bytes
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.full_disks import logged

log = logging.getLogger(__name__)

SUFFIX = ".shown"
"""Of the file, behind the store's name."""
MAGIC = b"mapweave shown 2\n"
"""Another number with another message `map`, or another entry of a robot (docs/http.md)."""
BEFORE = {"alive": False, "before": True}
"""Of the entry of a robot that the server has not heard of since it began."""


@dataclass(frozen=True)
class LastShown:
    """What viewers had on their pages.

    Attributes:
        map: the message `map`, whole; empty if there is none.
        robots: their entries, as in `GET /robots`.
        history: of the maps.
    """

    map: str = ""
    robots: tuple[Mapping[str, Any], ...] = ()
    history: tuple[MapEvent, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is anything to show."""
        return bool(self.map)

    @property
    def parts(self) -> list[frozenset[MapId]]:
        """The maps of each component, by their smallest."""
        parts = [frozenset(map(_map_id, one["maps"])) for one in json.loads(self.map)["components"]]
        return sorted(parts, key=min)

    @property
    def unheard(self) -> list[dict[str, Any]]:
        """The robots, as long as the server has heard of none."""
        return [{**robot, **BEFORE} for robot in self.robots]

    def fleet(self, fleet: FleetStatus, merged: MergedMap) -> list[dict[str, Any]]:
        """The robots that the server has heard of, on this map, and behind them those that it has not.

        Args:
            fleet: who is heard of.
            merged: the map in which they are placed, whose maps are not all merged yet.
        """
        heard = {entry.robot: entry for entry in fleet.robots if entry.status is not None}
        known = {str(robot["robot"]): robot for robot in self.unheard}
        return [
            self._placed(heard[name], merged) if name in heard else known[name]
            for name in sorted(heard.keys() | known.keys())
        ]

    def unheard_on(self, merged: MergedMap, fleet: FleetStatus) -> list[dict[str, Any]]:
        """The robots that the server has not heard of, by the nearest node that its own map has, too.

        Args:
            merged: the server's own map.
            fleet: who is heard of.
        """
        heard = {entry.robot for entry in fleet.robots if entry.status is not None}
        return [self._placed_on(merged, robot) for robot in self.unheard if str(robot["robot"]) not in heard]

    def _placed_on(self, merged: MergedMap, robot: dict[str, Any]) -> dict[str, Any]:
        nowhere = {**robot, "merged_from_robot": None, "component": -1}
        if not robot["merged_from_robot"]:
            return nowhere
        pose = Pose2(*robot["merged_from_robot"])
        common = [
            (here.distance(pose), node, here)
            for node, (here, component) in self._poses.items()
            if component == robot["component"] and merged.component_of(node) is not None
        ]
        if not common:
            return nowhere
        _, nearest, here = min(common, key=lambda one: one[0])
        moved = merged.pose(nearest) @ here.inverse() @ pose
        return {
            **robot,
            "merged_from_robot": moved.vector.tolist(),
            "component": merged.component_of(nearest),
        }

    def _placed(self, entry: RobotEntry, merged: MergedMap) -> dict[str, Any]:
        """An entry with its pose by the nearest node that this map has, too; without one it has no pose."""
        values = {**json_values(entry), "merged_from_robot": None, "component": -1}
        if entry.merged_from_robot is None or entry.component < 0:
            return values
        graph, pose = merged.graphs[entry.component], entry.merged_from_robot
        common = [row for row, node in enumerate(graph.nodes) if node in self._poses]
        if not common:
            return values
        away = graph.means[common, :2] - [pose.x, pose.y]
        nearest = graph.nodes[common[int(np.argmin((away**2).sum(1)))]]
        here, component = self._poses[nearest]
        moved = here @ merged.pose(nearest).inverse() @ pose
        return {**values, "merged_from_robot": moved.vector.tolist(), "component": component}

    @cached_property
    def _poses(self) -> Mapping[NodeId, tuple[Pose2, int]]:
        """Pose and component of each node."""
        message = json.loads(self.map)
        sent, maps = message["nodes"], [_map_id(name) for name in message["maps"]]
        columns = [np.frombuffer(b64decode(sent[name]), kind).tolist() for name, kind in NODE_COLUMNS]
        return {
            NodeId(maps[m].agent, maps[m].epoch, int(number)): (Pose2(x, y, heading), component)
            for m, number, x, y, heading, component, state in zip(*columns, strict=True)
            if state
        }


NOTHING = LastShown()


def _map_id(name: str) -> MapId:
    agent, epoch = name.rsplit(".", 1)
    return MapId(agent, int(epoch))


def read_shown(path: Path) -> LastShown:
    """What was shown last; nothing if no file is there, or another program's.

    Args:
        path: of the file that `write_shown` has written.
    """
    try:
        data = read_whole(path)
    except FileNotFoundError:
        return NOTHING
    except OSError as error:
        log.warning("%s: cannot be read (%s)", path, error.strerror or error)
        return NOTHING
    if not data.startswith(MAGIC):
        return NOTHING
    try:
        kept = json.loads(zlib.decompress(data[len(MAGIC) :]))
        events = [MapEvent(stamp, MapEventKind(kind), words) for stamp, kind, words in kept["history"]]
        if not isinstance(kept["map"], str) or not all(isinstance(one, dict) for one in kept["robots"]):
            raise TypeError("no map, or no robots")
        return LastShown(kept["map"], tuple(kept["robots"]), tuple(events))
    except (zlib.error, ValueError, KeyError, TypeError, RecursionError):
        log.warning("%s: is damaged; the map is shown once it is loaded", path)
        return NOTHING


def write_shown(path: Path, shown: LastShown) -> None:
    """Keep what is shown for the next start; that it cannot be kept is only logged.

    Args:
        path: of the file.
        shown: kept unless it is empty.
    """
    if not shown:
        return
    events = [(event.stamp_ns, event.kind.value, event.words) for event in shown.history]
    content = json_bytes({"map": shown.map, "robots": shown.robots, "history": events})
    try:
        write_whole(path, MAGIC + zlib.compress(content))
    except InvalidFile as error:
        if not logged(error):
            log.warning("%s; the next start shows no map before it is loaded", error)
