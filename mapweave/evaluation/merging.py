"""Merging on a recording: it is cut into robots, each maps its piece as if carried, and these are merged."""

import csv
import itertools
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mission import Carried
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.settings import AgentSettings
from mapweave.drawing.map_picture import MapPicture, draw_map
from mapweave.evaluation.map_score import FALSE_LINK, FALSE_LINK_TURN, link_recall, pose_error, score_map
from mapweave.evaluation.pieces import pieces, say
from mapweave.evaluation.truth import Truth
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.errors import DeviceError, InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.storage.map_file import write_map_file
from mapweave.terminal import tracked

FALSE_SHARE = 0.1
"""Outdoors a link leads to what is far away: it is false only if it is also off by this share of the distance
of the landmarks that it rests on."""


@dataclass(frozen=True)
class MergeEvaluation:
    """What came of it.

    Attributes:
        name: of the recording.
        robots: images of each.
        merged: the merged map.
        truth: `world_from_robot` of each node that it is known of.
        took_s: to compare and merge, s.
    """

    name: str
    robots: Mapping[str, int]
    merged: MergedMap
    truth: Mapping[NodeId, Pose2]
    took_s: float

    @property
    def links(self) -> list[Link]:
        """Between maps."""
        return [link for link in self.merged.links if not link.within]

    def false(self, link: Link) -> bool | None:
        """Whether a link is off by more than 0.5 m and a tenth of its landmarks' distance, or 15 degrees.

        None if unknown.
        """
        if link.a not in self.truth or link.b not in self.truth:
            return None
        metres, turn = pose_error(link.a_from_b.mean, self.truth[link.a].inverse() @ self.truth[link.b])
        least = max(FALSE_LINK, FALSE_SHARE * link.evidence.get("depth", 0.0))
        return metres > least or turn > FALSE_LINK_TURN

    def report(self) -> dict[str, Any]:
        """Figures by name, for JSON; None without truth in the recording."""
        verdicts = [self.false(link) for link in self.links]
        judged = [verdict for verdict in verdicts if verdict is not None]
        joined = {n: (c, p.mean) for n, (c, p) in self.merged.poses.items()}
        edges = [link.edge() for link in self.links]
        has_truth = bool(self.truth)
        score = score_map(joined, edges, self.truth)
        return {
            "recording": self.name,
            "robots": dict(self.robots),
            "truth": has_truth,
            "nodes": len(self.merged.poses),
            "components": len(self.merged.components),
            "links": len(verdicts),
            "false_links": sum(judged) if has_truth else None,
            "link_precision": round(1.0 - sum(judged) / len(judged), 4) if judged else None,
            "link_recall": _rounded(link_recall(edges, self.truth, ())) if has_truth else None,
            "loops": sum(link.within for link in self.merged.links),
            "refused": sum(r.link is not None for r in self.merged.refused),
            "merged_ate_m": _rounded(score.ate) if has_truth else None,
            "alone_ate_m": self._alone() if has_truth else None,
            "merge_s": round(self.took_s, 2),
        }

    def _alone(self) -> dict[str, float | None]:
        """Error of each robot's own maps, as they came from it, after one rigid alignment a map, m."""
        own: dict[str, dict[NodeId, tuple[int, Pose2]]] = {}
        for map_id, hybrid_map in self.merged.maps.items():
            placed = {n.id: (map_id.epoch, n.map_from_robot.mean) for n in hybrid_map.nodes.values()}
            own.setdefault(map_id.agent, {}).update(placed)
        return {agent: _rounded(score_map(placed, [], self.truth).ate) for agent, placed in own.items()}

    def write(self, folder: Path) -> list[Path]:
        """The merged map, a table of its links, and a picture.

        Raises:
            InvalidFile: the disk does not take it.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            paths = [folder / "merged.mapweave", folder / "links.csv", folder / "map.png"]
            write_map_file(paths[0], map_file_of(self.merged))
            with paths[1].open("w", newline="", encoding="utf-8") as file:
                table = csv.writer(file)
                table.writerow(["a", "b", "inliers", "kept", "false", "reason"])
                refused = [r for r in self.merged.refused if r.link is not None and not r.link.within]
                rows = [(link, "") for link in self.links] + [(r.link, r.reason) for r in refused if r.link]
                for link, reason in rows:
                    false = {None: "unknown", True: "yes", False: "no"}[self.false(link)]
                    table.writerow([link.a, link.b, link.weight, "no" if reason else "yes", false, reason])
            draw_map(self._picture(), paths[2])
        except OSError as error:
            raise InvalidFile(f"{folder}: cannot be written ({error.strerror})") from None
        return paths

    def _picture(self) -> MapPicture:
        """The components laid over the truth; without truth, the largest in its own frame."""
        whole = self.merged.union()
        joined = {n: (c, p.mean) for n, (c, p) in self.merged.poses.items()}
        edges: list[Edge] = list(whole.edges.values())
        false = frozenset(link.edge().id for link in self.links if self.false(link))
        count = len(self.merged.components)
        parts = "1 component" if count == 1 else f"{count} components"
        title = (
            f"{self.name}: {len(joined)} nodes of {len(self.robots)} robots, {parts}, {len(self.links)} links"
        )
        if not self.truth:
            largest = {n: pose for n, (c, pose) in joined.items() if c == 0}
            return MapPicture(title if count == 1 else f"{title}; the largest", largest, edges)
        score = score_map(joined, [], self.truth)
        laid = {n: score.world_from_component[c] @ p for n, (c, p) in joined.items() if n in self.truth}
        wrong = sum(self.false(link) is True for link in self.links)
        return MapPicture(f"{title} ({wrong} false), ATE {score.ate:.2f} m", laid, edges, false=false)


def changes(name: str, robot: Replay, settings: AgentSettings) -> Iterator[list[Change]]:
    """What a robot that is carried along adds to its map, image by image.

    One that cannot find itself on its map begins another, as a robot's process does.
    """
    epoch, pipeline = 0, None
    while (observation := robot.sense()) is not None:
        if pipeline is None or pipeline.lost:
            epoch, numbers = epoch + 1, itertools.count(1)
            map_id = MapId(name, epoch)
            calibration = pipeline.calibration if pipeline is not None else None
            pipeline = Pipeline(map_id, robot.describe(), settings, calibration=calibration)
            pipeline.set_mission(Carried())
        stamp_ns = observation.stamp_ns
        yield [
            Change(map_id, next(numbers), stamp_ns, body) for body in pipeline.step(observation, ()).changes
        ]
    if pipeline is not None:
        yield [Change(map_id, next(numbers), stamp_ns, body) for body in pipeline.finish()[0]]


def evaluate_merging(
    folder: Path, robots: int | None, settings: AgentSettings, merge: MergeSettings, console: Console
) -> MergeEvaluation:
    """Cut, map, merge.

    Args:
        folder: the recording.
        robots: see `mapweave.evaluation.pieces.pieces`.
        settings: of every robot's pipeline.
        merge: how the maps are merged.
        console: shows progress.

    Raises:
        DeviceError: the folder lacks what is needed, or a file is wrong.
    """
    cut = pieces(folder, robots)
    say((note for robot in cut.values() for note in robot.recording.notes), console)
    truth = Truth.read(folder / "truth.csv")
    merger = Merger(settings=merge)
    images = {}
    for name, robot in cut.items():
        images[name] = len(robot)
        for change in tracked(changes(name, robot, settings), f"{name} maps", len(robot), console=console):
            for part in change:
                merger.on_change(part)
    say((line for robot in cut.values() for line in robot.damage), console)
    console.print("merging")
    began = time.perf_counter()
    merged = merger.merged()
    took = time.perf_counter() - began
    if not merged.poses:
        raise DeviceError(
            f"{folder}: no robot has mapped anything; are there features, and does odometry.csv move?"
        )
    nodes = [node for part in merged.maps.values() for node in part.nodes.values()]
    true_poses = {n.id: pose for n in nodes if (pose := truth.robot_at(n.stamp_ns, n.camera)) is not None}
    return MergeEvaluation(folder.resolve().name, images, merged, true_poses, took)


def _rounded(value: float | None) -> float | None:
    return round(value, 4) if value is not None and math.isfinite(value) else None
